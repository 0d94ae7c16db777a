"""Diagnoses of many simulated rigs, of which no more than their features are kept.

    python -m experiments.gap.simulate OUT [--set calibration] [--seed 1] [--cases 1000]
        [--batch 1000] [--jobs 2] [--effort normal] [--with KEY=VALUE] [--batches N] [--retry]

The rigs of a set of the proof are planned from the seed, then recorded and diagnosed in batches.
Each diagnosis leaves a line in ``OUT/features.jsonl.gz`` (:mod:`.features_file`); recordings and
diagnoses are removed. Interrupted and called again it goes on where it was; one that could not be
diagnosed is told in its line, and tried again with ``--retry``. What is done with the lines:
:mod:`.calibrate`.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter

from msgspec import convert

from experiments.command_line import exit_code_of
from experiments.gap.blind.cases import Case, plan
from experiments.gap.blind.recording import Timing
from experiments.gap.blind.run import DOCUMENT_NAME, TIMING_NAME, diagnose_all
from experiments.gap.blind.sealing import RECORDINGS, REFERENCES, texts_of
from experiments.gap.blind.sets import SETS
from experiments.gap.features_file import FeaturesFile, Line, line_of
from trms_cli.core.errors import EXIT_OK, ConfigurationError
from trms_cli.core.plugins import nearest
from trms_cli.core.whole_file import replace_whole
from trms_cli.runs.run_folder import hold, in_use

_REQUEST, _CASES, _DIAGNOSES = "simulation.json", "cases.json", "found"


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """Which rigs, and how they are diagnosed."""

    set: str = "calibration"  #: Of :data:`experiments.gap.blind.sets.SETS`
    seed: int = 1
    cases: int | None = None  #: None: as many as the set has
    batch: int = 1000  #: Rigs that are recorded together, all in the time of the longest
    duration: float | None = None  #: s; None: each rig its own
    words: tuple[str, ...] = ()  #: Options of ``trms diagnose``

    def batches(self) -> list[dict[str, Case]]:
        """All cases by name."""
        cases = plan(self.set, self.seed, self.cases)
        named_cases = [(f"s{i:05d}", case) for i, case in enumerate(cases, start=1)]
        return [
            dict(named_cases[i : i + self.batch]) for i in range(0, len(named_cases), self.batch)
        ]


def simulate(
    request: Simulation,
    out: Path,
    *,
    jobs: int,
    tell: Callable[[str], None],
    batches: int | None = None,
    retry: bool = False,
) -> list[Line]:
    """Diagnose what has no line yet; all lines.

    ``batches``: no more than so many now. Raises ConfigurationError if the folder holds another
    simulation.
    """
    out.mkdir(parents=True, exist_ok=True)
    if not hold(out):
        raise in_use(out)
    _same_request(request, out)
    file = FeaturesFile(out)
    line_names = {line.name for line in file.mend(without_failed=retry)}
    planned = request.batches()
    total = sum(map(len, planned))
    begin, before = perf_counter(), len(line_names)
    for number, cases in enumerate(planned):
        missing = [name for name in cases if name not in line_names]
        if not missing:
            continue
        if batches == 0:
            break
        batches = None if batches is None else batches - 1
        folder = out / f"batch{number:04d}"
        tell(f"batch {number + 1} of {len(planned)}: {len(cases)} rigs move")
        driven_cases = _recorded(request, number, cases, folder, jobs)

        def keep(
            name: str, message: str, of: Mapping[str, Case] = driven_cases, at: Path = folder
        ) -> None:
            file.append(_line(name, of[name], message, at / _DIAGNOSES / name))
            shutil.rmtree(at / _DIAGNOSES / name, ignore_errors=True)
            line_names.add(name)
            spent = perf_counter() - begin
            rest = spent / (len(line_names) - before) * (total - len(line_names))
            tell(
                f"{len(line_names):5d} of {total}  {name}  {message[:60]:16}  "
                f"{rest / 3600:.1f} h to go"
            )

        (folder / _DIAGNOSES).mkdir(exist_ok=True)
        waiting = [folder / RECORDINGS / f"{name}.csv" for name in missing]
        whole = [r for r in waiting if (folder / _DIAGNOSES / r.stem / DOCUMENT_NAME).is_file()]
        for recording in whole:  # diagnosed when it was interrupted
            keep(recording.stem, "")
        rest = [recording for recording in waiting if recording not in whole]
        words = ["advise=false", *request.words]  # no feature
        diagnose_all(rest, folder / _DIAGNOSES, words, jobs, keep)
        shutil.rmtree(folder)
    return file.lines()


def _same_request(request: Simulation, out: Path) -> None:
    path, own = out / _REQUEST, json.loads(json.dumps(asdict(request)))
    if not path.is_file():
        replace_whole(path, (json.dumps(own, indent=2) + "\n").encode())
        return
    there = json.loads(path.read_text(encoding="utf-8"))
    other = [key for key in own if own[key] != there.get(key)]
    if other:
        raise ConfigurationError(
            f"this folder is of a simulation with another {', '.join(other)}",
            where=str(out),
            remedy="name another folder, or ask for the same again",
        )


def _recorded(
    request: Simulation, number: int, cases: Mapping[str, Case], folder: Path, jobs: int
) -> dict[str, Case]:
    """The cases of a batch as driven; their recordings are in the folder."""
    cases_file = folder / _CASES
    if cases_file.is_file():
        return convert(json.loads(cases_file.read_text(encoding="utf-8")), dict[str, Case])
    shutil.rmtree(folder, ignore_errors=True)
    # a batch has noise of its own
    driven_cases, *texts = texts_of(
        cases, Timing(duration=request.duration), request.seed + 1_000_003 * number, jobs
    )
    for place, texts_by_name in zip((RECORDINGS, REFERENCES), texts, strict=True):
        (folder / place).mkdir(parents=True)
        for name, text in texts_by_name.items():
            (folder / place / f"{name}.csv").write_text(text, encoding="utf-8")
    content = {name: asdict(case) for name, case in driven_cases.items()}
    replace_whole(cases_file, json.dumps(content).encode())
    return driven_cases


def _line(name: str, case: Case, message: str, folder: Path) -> Line:
    document = folder / DOCUMENT_NAME
    if not document.is_file():
        return Line(name=name, case=case, document={}, failed=message or "no diagnosis")
    took = json.loads((folder / TIMING_NAME).read_text(encoding="utf-8"))["seconds"]
    return line_of(name, case, json.loads(document.read_text(encoding="utf-8")), took)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m experiments.gap.simulate",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--set", default="calibration")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--cases", type=int, default=None)
    parser.add_argument("--batch", type=int, default=1000)
    parser.add_argument("--duration", type=float, default=None, help="s; default: each its own")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--effort", default="normal")
    parser.add_argument("--with", dest="words", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--batches", type=int, default=None, help="no more than so many now")
    parser.add_argument("--retry", action="store_true", help="what could not be diagnosed as well")
    return parser


def _study(arguments: argparse.Namespace) -> int:
    if arguments.set not in SETS:
        raise ConfigurationError(
            f"there is no set {arguments.set!r}", where="--set", remedy=nearest(arguments.set, SETS)
        )
    request = Simulation(
        set=arguments.set,
        seed=arguments.seed,
        cases=arguments.cases,
        batch=arguments.batch,
        duration=arguments.duration,
        words=(f"effort={arguments.effort}", *arguments.words),
    )
    lines = simulate(
        request,
        arguments.out,
        jobs=arguments.jobs,
        tell=lambda words: print(words, file=sys.stderr, flush=True),
        batches=arguments.batches,
        retry=arguments.retry,
    )
    failed = [line for line in lines if line.failed]
    print(f"{len(lines) - len(failed)} diagnoses, {len(failed)} failures in {arguments.out}")
    for line in failed[:20]:
        print(f"  {line.name}: {line.failed.splitlines()[0]}")
    print(f"then: python -m experiments.gap.calibrate {arguments.out}")
    return EXIT_OK


def main(argv: Sequence[str] | None = None) -> int:
    """Simulate what is asked for, and what is not simulated yet."""
    arguments = _parser().parse_args(argv)
    return exit_code_of(lambda: _study(arguments))


if __name__ == "__main__":
    sys.exit(main())
