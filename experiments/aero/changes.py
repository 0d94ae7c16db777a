"""``python -m experiments.aero.changes aero/``: all recordings diagnosed, with and without against.

Each recording of the normal state is questioned against the others, each other one against all of
the normal state. A table of what is said, and how long it took.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter

from trms_cli.gap.change import compare
from trms_cli.gap.change_result import change_result
from trms_cli.gap.diagnose import diagnose
from trms_cli.gap.diagnosis import DiagnosisResult
from trms_cli.gap.problem import GapProblem
from trms_cli.identification.data import DataOptions, load_datasets
from trms_cli.identification.dataset import Dataset
from trms_cli.library.tasks.diagnose import candidates_of
from trms_cli.models.quanser_aero import QuanserAero

_NORMAL_RECORDINGS = ("nominal_a", "nominal_b", "nominal_c")
_QUESTIONED = (*_NORMAL_RECORDINGS, "mass_a", "friction_a")
#: rad, of the encoders of angles as the recordings are read everywhere
_QUANTUM = 0.0015339807878856412


def main(argv: Sequence[str] | None = None) -> int:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(prog="python -m experiments.aero.changes", description=__doc__)
    parser.add_argument("folder", type=Path, help="with the recordings")
    parser.add_argument("--only-against", action="store_true", help="leave the others out")
    parser.add_argument("--only", nargs="*", default=_QUESTIONED, help="recordings in question")
    parser.add_argument(
        "--references",
        nargs="+",
        choices=_NORMAL_RECORDINGS,
        default=_NORMAL_RECORDINGS,
        help="recordings of the normal state to compare with",
    )
    arguments = parser.parse_args(argv)
    missing = [n for n in _QUESTIONED if not (arguments.folder / f"{n}.csv").is_file()]
    if missing:
        print(f"skipped: {', '.join(missing)} not in {arguments.folder}", file=sys.stderr)
        return 0
    heads = ("recording", "against", "verdict", "likeliest", "since", "place", "time")
    print(f"| {' | '.join(heads)} |\n{'|---' * len(heads)}|")
    for name in arguments.only:
        others = tuple(n for n in arguments.references if n != name)
        for against in dict.fromkeys(((), others)):  # none but itself: once
            if against or not arguments.only_against:
                begin = perf_counter()
                result = diagnosis(arguments.folder, name, against)
                print(_row(name, against, result, perf_counter() - begin), flush=True)
    return 0


def diagnosis(folder: Path, name: str, against: Sequence[str]) -> DiagnosisResult:
    """What is said of a recording."""
    model = QuanserAero(parameter_set="quanser_aero_record")
    options = DataOptions(quantum=dict.fromkeys(("alpha_v", "alpha_h"), _QUANTUM))

    def read(names: Sequence[str]) -> tuple[Dataset, ...]:
        return tuple(load_datasets([str(folder / f"{n}.csv") for n in names], model, options))

    problem = GapProblem(
        model=model,
        model_name="quanser_aero",
        datasets=read([name]),
        against=read(against) if against else (),
        candidates=candidates_of(["all"], model).effects,
        block=6.0,
    )
    return change_result(problem, compare(problem)) if against else diagnose(problem)


def _row(name: str, against: Sequence[str], result: DiagnosisResult, seconds: float) -> str:
    causes = [c for c in result.causes if c.probability >= 0.03]
    likeliest = ", ".join(f"{' + '.join(c.effects)} {c.probability:.2f}" for c in causes)
    onset = next((c.onset for c in causes if c.onset is not None), None)
    since = "" if onset is None else f"{onset.time_s:.1f} s"
    place = ", ".join(f"{w.location} {w.share:.2f}" for w in result.where[:2])
    references = ", ".join(against) or "–"
    cells = (name, references, result.verdict, likeliest, since, place, f"{seconds:.0f} s")
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    sys.exit(main())
