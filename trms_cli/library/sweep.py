"""Many runs from one call: ``trms run -m``, and what came of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from trms_cli.composition.arguments import Arguments, arguments_of, path_of, text_of
from trms_cli.core.errors import ConfigurationError, RecordingError
from trms_cli.core.findings import Findings, Judgement, Measure, Section, Table
from trms_cli.library import html
from trms_cli.library.call import remarks, turn, words_of
from trms_cli.library.comparison import Comparison, compare
from trms_cli.library.result import Paths, Result
from trms_cli.library.run import Run, run_in
from trms_cli.library.studies import Diagnosis, Excitation, Fit, Stability, Validation

if TYPE_CHECKING:
    import pandas  # type: ignore[import-untyped,unused-ignore]

    from trms_cli.sweeps.driver import SweepOutcome


@dataclass(frozen=True, repr=False, eq=False)
class Sweep(Result):
    """Many runs in one folder, each in a numbered folder of its own."""

    FILES: ClassVar[Mapping[str, str]] = {}

    @property
    def document(self) -> dict[str, Any]:
        """``trms.sweep-status/1``: how it stands now, failures by their reason, the best."""
        from trms_cli.sweeps.outcome import outcome_of

        return outcome_of(self.folder)

    @property
    def counts(self) -> dict[str, int]:
        """Runs ``done``, ``failed``, ``lost``, ``interrupted``, ``running``, ``left``."""
        return dict(self.document["counts"])

    @property
    def frame(self) -> pandas.DataFrame:
        """A row a run, by its number: what was varied, and every figure of its score."""
        from trms_cli.runs.frame import runs_frame
        from trms_cli.sweeps.record import Record

        frame = runs_frame("", self.folder, sort="path")
        frame.index = [int(Path(place).name) for place in frame["path"]]
        frame.index.name = "run"
        frame = frame.sort_index()
        values = {point.number: point.values for point in Record(self.folder).points()}
        for key in dict.fromkeys(key for point_values in values.values() for key in point_values):
            if key not in frame:
                frame[key] = [_number(values.get(run, {}).get(key)) for run in frame.index]
        return frame

    @property
    def best(self) -> Run | None:
        """The run with the smallest objective (tracking RMSE, all channels added)."""
        best = self.document["best"]
        return None if best is None else self[best["run"]]

    def __getitem__(self, number: int) -> Run:
        """A run by its number, from 0 on.

        Raises
        ------
        RecordingError
            If there is no such run; it names those there are.
        """
        if not (self.folder / str(number)).is_dir():
            there = sorted(int(p.name) for p in self.folder.iterdir() if p.name.isdecimal())
            raise RecordingError(
                f"there is no run {number!r}",
                where=str(self.folder),
                remedy=f"runs that have a folder: {_spans(there)}" if there else "none is made yet",
            )
        return run_in(self.folder / str(number))

    def __len__(self) -> int:
        return int(self.document["total"] or sum(self.counts.values()))

    def compare(self, **how: Any) -> Comparison:
        """Its runs ranked; arguments as of :func:`trms_cli.compare`."""
        return compare(self.folder, **how)

    def resume(self, *settings: str, retry_failed: bool = False, verbose: bool = False) -> Sweep:
        """Go on where it stopped: ``trms sweep resume``; no run is made twice.

        Parameters
        ----------
        *settings : str
            ``"launcher=…"``, ``"launcher.workers=4"``, ``"retries=2"``, instead of those it has.
        retry_failed : bool
            Whether runs that failed or were lost are made again.
        verbose : bool
            Show progress.
        """
        from trms_cli.library.tasks.sweep import go_on

        drive = partial(go_on, self.folder, settings=settings, retry_failed=retry_failed)
        _drive(f"Python: resume({str(self.folder)!r})", drive, verbose=verbose)
        return self

    @property
    def headline(self) -> str:
        """How many runs, and where."""
        tally = ", ".join(f"{n} {state}" for state, n in self.counts.items() if n)
        return f"{tally or 'no run yet'}: {self.folder}"

    def _repr_html_(self) -> str:
        document, counts = self.document, self.counts
        lead, sections = [], []
        if document["best"] is not None:
            best = document["best"]
            lead.append(f"The best, {best['objective']:.3g}: {' '.join(best['overrides'])}.")
        if document["failures"]:
            rows = [[f["count"], f["problem"]] for f in document["failures"]]
            sections.append(Section("Failures", blocks=[Table(["runs", "that failed"], rows)]))
        judgements: dict[str, Judgement] = {"done": "good", "failed": "bad"}
        measures = [
            Measure(state, count, "", judgements.get(state, ""))
            for state, count in counts.items()
            if count
        ]
        title = self.folder.name or str(self.folder)
        findings = Findings(f"Sweep {title}", lead, sections, measures=measures)
        return html.view(findings, paths={"folder": self.folder})


def sweep(
    *overrides: str,
    sampler: Any = None,
    launcher: Any = None,
    workers: int | None = None,
    retries: int | None = None,
    out: str | PathLike[str] | None = None,
    config_dir: Paths = (),
    verbose: bool = False,
    **keys: Any,
) -> Sweep:
    """Make one run for each combination of values: ``trms run -m``.

    A list is what a key takes in turn; a list inside it is one value.

    Parameters
    ----------
    *overrides : str
        As after ``-m``: ``"controller=pid,lqr"``, ``"seed=range(10)"``,
        ``"plant.parameters=prior"``.
    sampler : str or mapping
        How values are chosen: ``"grid"``, ``{"latin_hypercube": {"samples": 200}}``, ….
    launcher : str or mapping
        Where runs are made: ``"local"``, ``{"dask": {"address": "tcp://head:8786"}}``, ….
    workers : int
        Processes; by default all cores.
    retries : int
        Times that a run is tried again after its worker died.
    out : path
        The folder of the sweep, new or empty.
    config_dir : path or sequence of paths
    verbose : bool
        Show progress.
    **keys
        As of :func:`trms_cli.run`, with lists for what varies: ``controller=["pid", "lqr"]``,
        ``seed=range(3)``, ``plant={"parameters": {"k_g": [0.1, 0.2]}}``,
        ``effect=[["main_dead_zone", "main_inflow"], "yaw_coulomb_friction"]``. Objects cannot be
        swept: runs are made in other processes.

    Returns
    -------
    Sweep
        ``.frame``, ``.counts``, ``.best``, ``.compare()``, ``[number]``, ``.resume()``.

    Raises
    ------
    TrmsError
        For what cannot be composed, before anything is written.
    KeyboardInterrupt
        If it was stopped; ``trms_cli.load(folder).resume()`` goes on.

    Examples
    --------
    >>> swept = sweep(controller=["pid", "lqr"], seed=range(3), sim={"duration": 20})
    >>> swept.frame.groupby("controller").rmse_alpha_h.median()
    """
    from trms_cli.library.tasks.run import job
    from trms_cli.library.tasks.sweep import make_sweep

    steering = {"sampler": sampler, "launcher": launcher, "retries": retries}
    arguments = _sweep_arguments(overrides, keys, steering, workers, config_dir)
    if out is not None:
        words = (*arguments.words, f"out={text_of(str(path_of(out, 'out')))}")
        arguments = Arguments(words, {}, arguments.config_dirs)
    line = words_of("run", Arguments(("-m", *arguments.words), {}, arguments.config_dirs))
    drive = partial(make_sweep, arguments.words, "run", job, config_dirs=arguments.config_dirs)
    return Sweep(_near(_drive(line, drive, verbose=verbose).folder))


def load(path: str | PathLike[str]) -> Result:
    """What a command left in a folder, from the command line or from Python, opened again.

    Parameters
    ----------
    path : path
        The folder, or a run's log.

    Returns
    -------
    Run, Sweep, Fit, Validation, Stability, Diagnosis or Excitation

    Raises
    ------
    RecordingError
        If no command left that.

    Examples
    --------
    >>> fit = load("outputs/2025-01-31/12-00-00-identify")
    """
    folder = path_of(path, "path")
    kinds: tuple[type[Result], ...] = (Fit, Validation, Stability, Diagnosis, Excitation)
    for kind in kinds:
        if (folder / kind.DOCUMENT).is_file():
            return kind(folder)
    if (folder / "sweep.json").is_file():
        return Sweep(folder)
    if folder.is_file() or (folder / "run.mcap").is_file():
        return run_in(folder)
    raise RecordingError(
        "no command left its results here",
        where=str(path),
        remedy="name the folder that run, identify, validate, stability, diagnose or excite "
        "wrote into",
    )


def _drive(words: str, drive: Callable[..., SweepOutcome], *, verbose: bool) -> SweepOutcome:
    """Drive a sweep to its end, as a call in `words`: shown as by the command, or in silence."""
    from trms_cli.reporting.sweep_screen import on_screen

    with turn(words), remarks(verbose):
        return on_screen(drive) if verbose else drive()


def _sweep_arguments(
    overrides: Sequence[str],
    keys: Mapping[str, Any],
    steering: Mapping[str, Any],
    workers: int | None,
    config_dir: Paths,
) -> Arguments:
    """What varies in the grammar of ``-m``, and the sweep's own settings."""
    varied: dict[str, list[Any]] = {}
    fixed = _without_lists(keys, varied)
    plain = arguments_of("run", (), fixed, config_dir=config_dir)
    words = list(plain.words)
    for key, values in varied.items():
        words.append(f"{key}={','.join(_value(key, value, config_dir) for value in values)}")
    own = {key: value for key, value in steering.items() if value is not None}
    settings = arguments_of("sweep", (), own, config_dir=config_dir)
    words += settings.words
    words += [f"launcher.workers={workers}"] if workers is not None else []
    _refuse_objects({**plain.objects, **settings.objects})
    return Arguments((*words, *overrides), {}, plain.config_dirs)


def _without_lists(
    keys: Mapping[str, Any], varied: dict[str, list[Any]], prefix: str = ""
) -> dict[str, Any]:
    """The keys without those that a list varies, which go to `varied` by their dotted names."""
    remainder: dict[str, Any] = {}
    for name, value in keys.items():
        place = f"{prefix}{name}"
        if isinstance(value, Mapping):
            remainder[name] = _without_lists(value, varied, f"{place}.")
        elif isinstance(value, list | tuple | range) or type(value).__name__ == "ndarray":
            varied[place] = list(value)
        else:
            remainder[name] = value
    return remainder


def _value(key: str, value: Any, config_dir: Paths) -> str:
    """One of the values that a key takes in turn."""
    arguments = arguments_of("run", (), {key: value}, config_dir=config_dir)
    _refuse_objects(arguments.objects)
    if len(arguments.words) != 1:
        raise ConfigurationError(
            f"{value!r} among the values of a sweep",
            where=key,
            remedy=f"vary its keys by themselves: {key}={{KEY: [VALUE, VALUE]}}",
        )
    return arguments.words[0].partition("=")[2]


def _refuse_objects(objects: Mapping[str, Any]) -> None:
    for place, plugin in objects.items():
        raise ConfigurationError(
            f"the object {plugin!r} given",
            where=place,
            remedy="runs of a sweep are made in other processes: give the class a YAML "
            "(docs/writing-a-plugin.md) and its folder as config_dir, or call run() in a loop",
        )


def _spans(numbers: Sequence[int]) -> str:
    """``0–3, 5``: ascending numbers, those in a row together."""
    rows: list[list[int]] = []
    for number in numbers:
        if rows and rows[-1][-1] == number - 1:
            rows[-1].append(number)
        else:
            rows.append([number])
    return ", ".join(f"{row[0]}–{row[-1]}" if len(row) > 1 else str(row[0]) for row in rows)


def _number(value: Any) -> Any:
    """A choice that is a number as that."""
    try:
        return float(value)
    except (TypeError, ValueError):
        return value


def _near(folder: Path) -> Path:
    """A folder under the working folder without it: as other results name theirs."""
    here = Path.cwd()
    return folder.relative_to(here) if folder.is_relative_to(here) else folder
