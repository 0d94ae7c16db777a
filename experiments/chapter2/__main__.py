"""``python -m experiments.chapter2``: simulate, draw, write the tables, check the figures."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments.chapter2.agreement import study_agreement
from experiments.chapter2.axes import ANGLES, Comparison, one_axis, two_axes
from experiments.chapter2.bench_tests import study_bench_tests
from experiments.chapter2.friction import AXES, study_friction
from experiments.chapter2.interface import study_interface
from experiments.chapter2.paths import study_paths
from experiments.chapter2.rotors import ROTORS, study_rotor
from experiments.chapter2.study import HERE, STUDY, read_study
from experiments.command_line import exit_code_of, progress_with_time
from experiments.expected_figures import json_text, rounded
from experiments.page_tables import write_alone, write_tables
from trms_cli.core.errors import EXIT_OK

DOCS = HERE.parents[1] / "docs"
PAGE, FIGURES = DOCS / "chapter2.md", DOCS / "figures" / "chapter2"
EXPECTED = HERE / "expected.json"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m experiments.chapter2", description=__doc__)
    parser.add_argument("--study", type=Path, default=STUDY, help="another study.yaml")
    parser.add_argument(
        "--out", type=Path, help="put tables, figures and JSON there and leave docs/ as it is"
    )
    arguments = parser.parse_args(argv)
    return exit_code_of(lambda: _run(arguments))


def _run(arguments: argparse.Namespace) -> int:
    from experiments import block_diagrams
    from experiments.chapter2 import drawing, figures, page

    study = read_study(arguments.study)
    folder = arguments.out or FIGURES
    folder.mkdir(parents=True, exist_ok=True)
    report = progress_with_time()

    drawing.draw_rig(folder / "rig.png", folder / "rig.svg")
    block_diagrams.draw_newtonian(folder / "newtonian.png")
    circuits = [study_interface(study, rotor) for rotor in ROTORS]
    figures.draw_interfaces(circuits, folder / "interface.png")
    report("the rig, its block diagram, interface circuits")

    rotors = [study_rotor(study, rotor) for rotor in ROTORS]
    figures.draw_rotors(rotors, folder / "rotors.png")
    tables = {"interface": page.interface_table(circuits), **page.rotor_tables(rotors)}
    report("rotors alone: static curves, steps, sines")

    frictions = [study_friction(study, freedom) for freedom in AXES]
    figures.draw_friction(frictions, folder / "friction.png")
    tables["friction"] = page.friction_table(frictions)
    report("friction profiles of the rigs with one axis")

    single = {freedom: one_axis(study, freedom) for freedom in study.one_axis}
    for freedom, cases in single.items():
        angle = "alpha_v" if freedom == "vertical" else "alpha_h"
        figures.draw_responses(cases, angle, folder / f"{freedom}.png")
        tables[freedom] = page.one_axis_table(cases)
    report(f"one axis: {sum(map(len, single.values()))} cases")

    cases = two_axes(study)
    for angle, axis in zip(ANGLES, ("pitch", "yaw"), strict=True):
        figures.draw_responses(cases, angle, folder / f"two_axes_{axis}.png")
        figures.draw_spectra(cases, angle, folder / f"two_axes_{axis}_spectra.png")
    tables |= page.two_axes_tables(cases)
    report(f"two axes: {len(cases)} cases")

    signals = page.signals_of(study)
    tables["nine signals"] = page.signal_table(signals)
    paths = study_paths(study)
    figures.draw_paths(paths, folder / "paths.png")
    tables["nine pairs"] = page.path_table(paths)
    report(f"signals: {len(signals)} commands, {len(paths)} pairs by multisines")

    agreements, terms = study_agreement(study)
    tables |= page.agreement_tables(agreements, terms)
    report("where the models agree, and what parts them")

    results, records = study_bench_tests(study)
    figures.draw_bench_tests(records, folder / "bench_tests.png")
    tables["bench tests"] = page.bench_table(results)
    report(f"bench tests: {study.bench_tests.repetitions} repetitions")

    document = {
        "schema": "trms.chapter2/1",
        "rotors": {
            r.axis: {"rise_s": r.rises, "gain": r.gains, "current_effect_rad_s": r.current_effect}
            for r in rotors
        },
        "friction": {
            rig.freedom: {
                "break_away_N_m": rig.break_away,
                "rests_s": rig.rests,
                "offset_rad": rig.offsets,
            }
            for rig in frictions
        },
        "interface": {
            c.rotor: {
                "gain": c.gain,
                "saturates_at_V": c.saturates_at,
                "current_A": float(c.currents[-1]),
            }
            for c in circuits
        },
        "signals": {
            f"{name} {channel.name}": {
                "mean": channel.mean,
                "sd": channel.sd,
                "peak_Hz": channel.peak_frequency,
                "band_edge_Hz": channel.band_edge,
            }
            for name, channels in signals.items()
            for channel in channels
            if page.moves(channel)
        },
        "paths": {
            f"{p.source} {p.target}": {
                "static_gain": p.static_gain,
                "peak": p.peak,
                "peak_Hz": p.peak_frequency,
                "bandwidth_Hz": p.bandwidth,
                "delay_s": p.delay,
                "coherence": p.mean_coherence(p.coherence),
                "coherence_large": p.mean_coherence(p.coherence_large),
            }
            for p in paths
        },
        "one_axis": {freedom: _figures(cases) for freedom, cases in single.items()},
        "two_axes": _figures(cases),
        "agreement_rad": {a.what: a.largest for a in agreements},
        "terms_rms_rad": {
            t.name: {"all": t.newtonian, **t.left_wrong, "arm": t.arm} for t in terms
        },
        "bench_tests": {
            f.name: {"true": f.true, "mean": f.mean, "sd": f.sd, "unit": f.unit} for f in results
        },
    }
    text = json_text(rounded(document))
    if arguments.out is None:
        EXPECTED.write_text(text, encoding="utf-8")
        write_tables(PAGE, tables)
        report(f"written: {PAGE.relative_to(DOCS.parent)}, {FIGURES.relative_to(DOCS.parent)}")
    else:
        (folder / "chapter2.json").write_text(text, encoding="utf-8")
        write_alone(folder, tables)
        report(f"written: {folder}")
    return EXIT_OK


def _figures(cases: Sequence[Comparison]) -> dict[str, Any]:
    return {
        case.name: {
            angle: {"rms_rad": d.rms, "max_rad": d.largest, "fit_percent": d.fit}
            for angle, d in case.differences.items()
            if angle in ANGLES
        }
        for case in cases
    }


if __name__ == "__main__":
    sys.exit(main())
