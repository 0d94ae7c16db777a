"""``python -m experiments.aero aero/``: fit a part of nominal_a, judge on what is left."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.aero.study import (
    AeroFit,
    errors,
    fit_model,
    parts_of,
    problem_of,
    read_study,
    recording,
)
from experiments.command_line import exit_code_of
from trms_cli.core.errors import EXIT_OK
from trms_cli.models.quanser_aero import QuanserAero


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study and print its tables, or one JSON document."""
    parser = argparse.ArgumentParser(prog="python -m experiments.aero", description=__doc__)
    parser.add_argument("folder", type=Path, help="with nominal_a.csv and nominal_b.csv")
    parser.add_argument("--fit-only", action="store_true", help="leave nominal_b alone")
    parser.add_argument("--variants", action="store_true", help="fit what leaves a part out, too")
    parser.add_argument("--figure", type=Path, default=None, help="draw nominal_b to this file")
    parser.add_argument("--jobs", type=int, default=2, help="threads")
    parser.add_argument("--json", action="store_true", help="print trms.aero_fit/1")
    arguments = parser.parse_args(argv)
    settings = read_study()
    if not (arguments.folder / settings["fitted"]).is_file():
        print(f"skipped: there is no {settings['fitted']} in {arguments.folder}", file=sys.stderr)
        return 0
    return exit_code_of(lambda: _study(arguments, settings))


def _study(arguments: argparse.Namespace, settings: dict[str, Any]) -> int:
    document = _document(arguments, settings)
    print(json.dumps(document, indent=1) if arguments.json else _table(document))
    return EXIT_OK


def _document(arguments: argparse.Namespace, settings: dict[str, Any]) -> dict[str, Any]:
    first, rest = parts_of(recording(arguments.folder, settings["fitted"], settings), settings)
    variants: dict[str, Any] = {"fitted": {}}
    if arguments.variants:
        variants |= settings["variants"]
    fits = {
        name: fit_model(problem_of((first,), settings, without, arguments.jobs), settings)
        for name, without in variants.items()
    }
    published = QuanserAero(parameter_set=settings["set"], rotor_speeds=False)
    models = {"published": published} | {name: fit.model for name, fit in fits.items()}
    parts = {"fitted": first, "held_out": rest}
    if not arguments.fit_only:
        parts["nominal_b"] = recording(arguments.folder, settings["judged"], settings)
    if arguments.figure is not None and "nominal_b" in parts:
        from experiments.aero.figure import draw

        models_by_label = {"fitted to nominal_a": fits["fitted"].model, "published": published}
        draw(arguments.figure, parts["nominal_b"], models_by_label)
    return {
        "schema": "trms.aero_fit/1",
        "fits": {name: _of_fit(fit) for name, fit in fits.items()},
        "errors": {name: errors(models, part, settings) for name, part in parts.items()},
    }


def _of_fit(fit: AeroFit) -> dict[str, Any]:
    assert fit.result.covariance is not None
    sd = np.sqrt(np.diag(fit.result.covariance))
    return {
        "outcome": fit.result.outcome.value,
        "seconds": fit.result.seconds,
        "cost": fit.result.cost,
        "starts": fit.result.details["starts"],
        "on_bounds": fit.result.details["on_bounds"],
        "parameters": {
            p.name: {
                "value": fit.result.values[p.name],
                "sd": float(sd[i]),
                "prior": p.prior_mean,
                "prior_sd": p.prior_sd,
                "unit": p.unit,
            }
            for i, p in enumerate(fit.problem.free)
        },
    }


def _table(document: dict[str, Any]) -> str:
    rows: list[str] = []
    for name, fit in document["fits"].items():
        behind = [start["behind_best"] for start in fit["starts"]]
        deficits = ", ".join("–" if b is None else f"{b:.1f}" for b in behind)
        rows += [
            f"## {name}: {fit['outcome']}, {fit['seconds']:.0f} s, cost {fit['cost']:.1f}; "
            f"nats behind the best start: {deficits}",
            "",
            "| parameter | fitted | ± sd | prior | ± sd | unit |",
            "|---|---|---|---|---|---|",
        ]
        rows += [
            f"| `{key}` | {p['value']:.4g} | {p['sd']:.2g} | {p['prior']:.4g} | {p['prior_sd']:.2g}"
            f" | {p['unit']} |"
            for key, p in fit["parameters"].items()
        ]
        rows += ["", f"on bounds: {', '.join(fit['on_bounds']) or 'none'}", ""]
    horizons = next(iter(next(iter(document["errors"].values())).values()))["alpha_v"]["free_runs"]
    rows += [
        "Free runs, RMS in mrad; r1: autocorrelation of the one-step errors at one sample.",
        "",
        f"| part | output | model | {' | '.join(f'{h} s' for h in horizons)} | r1 | tests failed |",
        f"|---|---|---|{'---|' * len(horizons)}---|---|",
    ]
    for part, models in document["errors"].items():
        for channel in ("alpha_v", "alpha_h"):
            for name, errors_by_output in models.items():
                e = errors_by_output[channel]
                cells = [f"{1e3 * v:.2f}" for v in e["free_runs"].values()]
                cells += ["–"] * (len(horizons) - len(cells))
                failed = f"{len(e['tests_failed'])} of {e['tests']}"
                rows.append(
                    f"| {part} | {channel} | {name} | {' | '.join(cells)} "
                    f"| {e['autocorrelation']:.2f} | {failed} |"
                )
    return "\n".join(rows)


if __name__ == "__main__":
    sys.exit(main())
