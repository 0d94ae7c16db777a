"""``python -m experiments.chapter8``: laws, runs, domain; draw, write the tables, check."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from experiments.chapter8.coverage import study_coverage, study_standstill
from experiments.chapter8.domain import study_domain
from experiments.chapter8.laws import LawResult, study_laws
from experiments.chapter8.runs import Ran, cases, run_all
from experiments.chapter8.study import HERE, STUDY, read_study
from experiments.command_line import exit_code_of, progress_with_time
from experiments.expected_figures import json_text, rounded
from trms_cli.core.errors import EXIT_OK

DOCS = HERE.parents[1] / "docs"
PAGE, FIGURES = DOCS / "chapter8.md", DOCS / "figures" / "chapter8"
EXPECTED = HERE / "expected.json"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m experiments.chapter8", description=__doc__)
    parser.add_argument("--study", type=Path, default=STUDY, help="another study.yaml")
    parser.add_argument("--quick", action="store_true", help="two starts, the fast controllers")
    parser.add_argument("--jobs", type=int, default=2, help="runs at once")
    parser.add_argument("--out", type=Path, help="where tables, figures and JSON go")
    parser.add_argument(
        "--update", action="store_true", help="write docs/chapter8.md and expected.json"
    )
    parser.add_argument(
        "--timed", action="store_true", help="write the times too: on a quiet machine, --jobs 1"
    )
    arguments = parser.parse_args(argv)
    if arguments.update and arguments.quick:
        parser.error("--update takes the whole study")
    return exit_code_of(lambda: _run(arguments))


def _run(arguments: argparse.Namespace) -> int:
    from experiments import block_diagrams
    from experiments.chapter8 import figures, page
    from experiments.page_tables import write_alone, write_tables

    study = read_study(arguments.study)
    folder = FIGURES if arguments.update else (arguments.out or Path("outputs", "chapter8"))
    folder.mkdir(parents=True, exist_ok=True)
    report = progress_with_time()

    block_diagrams.draw_robust_mpc(folder / "controller.png")
    contained, clouds = study_coverage(study)
    figures.draw_polytope(clouds, folder / "polytope.png")
    tables = {"coverage": page.coverage_table(contained)}
    report(f"polytopes: {len(contained)} against {study.coverage.points} points each")

    gains = study_standstill(study)
    tables["standstill"] = page.standstill_table(gains)
    report("the standing tail rotor")

    laws: list[LawResult] = []
    if not arguments.quick:
        laws = study_laws(study)
        figures.draw_switching(laws, folder / "switching.png")
        tables |= page.laws_tables(laws)
        report(f"laws: {len(laws)}, each switched to its worst and at random")

    domain_map = study_domain(study, quick=arguments.quick)
    figures.draw_domain(domain_map, study.starts, folder / "domain.png")
    tables["domain"] = page.domain_table(domain_map)
    report(f"domain: {domain_map.yaw.size * domain_map.pitch.size} starts twice")

    runs: list[Ran] = []
    for ran in run_all(cases(study, quick=arguments.quick), arguments.jobs):
        runs.append(ran)
    for observer in dict.fromkeys(ran.case.observer for ran in runs):
        figures.draw_runs(runs, observer, folder / f"runs_{observer}.png")
    tables |= page.runs_tables(runs)
    report(f"runs: {len(runs)}")

    document = {
        "schema": "trms.chapter8/1",
        "coverage": [
            {"size": c.size, "components": c.components, "inside": c.inside, "largest": c.largest}
            for c in contained
        ],
        "standstill": {g.name: {"weakest": g.weakest, "gamma": g.gamma} for g in gains},
        "laws": [_law(law) for law in laws],
        "domain": domain_map.shares,
        "runs": [_ran(ran) for ran in runs],
    }
    text = json_text(rounded(document, 4))  # an interior point ends where it ends
    if arguments.update:
        if not arguments.timed:
            del tables["times"]
        EXPECTED.write_text(text, encoding="utf-8")
        write_tables(PAGE, tables)
        report(f"written: {PAGE.relative_to(DOCS.parent)}, {FIGURES.relative_to(DOCS.parent)}")
    else:
        (folder / "chapter8.json").write_text(text, encoding="utf-8")
        write_alone(folder, tables)
        report(f"written: {folder}")
    return EXIT_OK


def _law(law: LawResult) -> dict[str, Any]:
    guarantee = law.certificate
    return {
        "start": list(law.start),
        "kind": law.kind,
        "region": law.region,
        "vertices": law.vertices,
        "gamma": math.nan if guarantee is None else guarantee.gamma,
        "contraction": math.nan if guarantee is None else guarantee.contraction,
        "slack": law.slack,
        "cost": None if law.greedy is None else law.greedy.cost,
        "rise": None if law.greedy is None else law.greedy.rise,
        "decreasing": law.decreasing,
    }


def _ran(ran: Ran) -> dict[str, Any]:
    return {
        "controller": ran.case.controller,
        "observer": ran.case.observer,
        "start": list(ran.case.start),
        "ise": ran.ise,
        "settling": ran.settling,
        "largest": ran.largest,
        "relaxed": ran.relaxed,
        "failed": ran.failed,
    }


if __name__ == "__main__":
    sys.exit(main())
