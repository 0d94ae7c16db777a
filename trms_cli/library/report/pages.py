"""What a report is of, and its page: of a run, of a few runs over one another, of many.

::

    report = report_of(["first", "second/run.mcap"])
    write_page(report.findings, Path("report.html"), pictures=False)
"""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from trms_cli.core.data_file import absent, json_or_none
from trms_cli.core.errors import RecordingError
from trms_cli.core.wording import choice_labels
from trms_cli.library.report import sweeps
from trms_cli.library.report.summary import drawn_keys
from trms_cli.runs.index import column_of
from trms_cli.runs.run_folder import LOG_NAME, name_of

if TYPE_CHECKING:
    from trms_cli.core.findings import Findings
    from trms_cli.recordings.log_reader import LoggedRun
    from trms_cli.reporting.signals import RunReport
    from trms_cli.runs.query import QueryResult
    from trms_cli.scoring.comparison.ranking import Ranking
    from trms_cli.scoring.comparison.runs import ComparisonRun, State

_MOST_TEXT = 2_000  # characters of a fact
#: Packages whose versions are named on a page.
_PACKAGES = ("trms", "python", "numpy", "casadi")


def read_run(path: Path, *, name: str = "") -> RunReport:
    """Read a log, complete or not.

    `name`: what the run is called; by default its folder, or the file where that has another name.
    Raises RecordingError if it cannot be read, is no log of a run, or is larger than what is read.
    """
    from trms_cli.recordings.log_reader import read_log
    from trms_cli.reporting.signals import RunReport, limits_in

    log = read_log(path)
    texts = {key: str(value) for key, value in log.run.items()}
    return RunReport(
        name=name or name_of(path),
        tables=log.tables,
        score=_score_of_log(log),
        limits=limits_in(log),
        outcome=log.outcome,
        duration=log.duration_s,
        problems=log.problems,
        choices=_choices(texts, log.config),
        facts=_facts(log, texts, path),
        command=texts.get("command", "")[:_MOST_TEXT],
        repeat=f"trms run --from {shlex.quote(str(path))}" if log.config else "",
        config=log.config,
    )


def _score_of_log(log: LoggedRun) -> Mapping[str, Any]:
    """Scored afresh, as ``trms score`` does; what a log says of itself where that fails."""
    from trms_cli.scoring.score import score_log

    try:
        return score_log(log)
    except (RecordingError, ValueError, KeyError, IndexError, TypeError, AttributeError):
        return log.score


def _choices(texts: Mapping[str, str], config: str) -> dict[str, str]:
    choices = json_or_none(texts.get("choices"))
    if not isinstance(choices, Mapping):
        return {}
    labels = choice_labels(choices, config)
    return {
        group: label[:_MOST_TEXT] for group, label in labels.items() if label not in ("", "none")
    }


def _facts(log: LoggedRun, texts: Mapping[str, str], path: Path) -> dict[str, str]:
    facts = {}
    for key, words in (("seed", "seed"), ("recording.file", "recording"), ("start", "begun")):
        if texts.get(key):
            facts[words] = texts[key][:_MOST_TEXT]
    if "begun" in facts:  # to the second
        facts["begun"] = re.sub(r"^(\S{10})T(\S{8})\.\d+\+00:00$", r"\1 \2 UTC", facts["begun"])
    facts["log"] = str(path)
    versions = json_or_none(texts.get("versions"))
    if isinstance(versions, Mapping):
        package_versions = [f"{name} {versions[name]}" for name in _PACKAGES if name in versions]
        if texts.get("git"):
            package_versions.append(f"git {texts['git']}")
        facts["versions"] = ", ".join(package_versions)[:_MOST_TEXT]
    return facts


#: Coordinates that every ranking looks at, also where runs do not differ in them.
_DRAW = "draw"
_RANKED = ("controller", "observer", "ref", "model", "plant", "seed")


def ranking_of(runs: Sequence[ComparisonRun]) -> Ranking | None:
    """The ranking that ``trms compare`` prints; None where nobody can be ranked."""
    from trms_cli.scoring.comparison.ranking import group, rank

    contest = group(runs)
    # Who differs from the others in draws or seeds alone is luckier, not better.
    if contest.by and all(key == _DRAW or key.endswith("seed") for key in contest.by):
        return None
    ranking = rank(contest)
    return ranking if ranking.best else None


def runs_of_rows(
    result: QueryResult,
    draw_keys: Sequence[str] = (),
    typed: Sequence[Mapping[str, Any]] | None = None,
) -> list[ComparisonRun]:
    """Rows of the index as a ranking takes them, without reading a log again.

    All that was drawn for a run, by `draw_keys`, is one coordinate, its draw: a condition, and no
    entrant's.
    """
    from trms_cli.scoring.comparison.runs import FIGURE_COLUMNS, ComparisonRun

    rows = result.runs
    typed = sweeps.typed_values(rows) if typed is None else typed
    keys = [key for key in sweeps.keys_of(rows, typed) if key not in draw_keys]
    ranked_keys = tuple(dict.fromkeys((*_RANKED, *keys)))
    columns = {key: _coordinates(rows, typed, key) for key in ranked_keys}
    if draw_keys:
        draws: dict[tuple[str, ...], str] = {}
        drawn = (tuple(str(values.get(key)) for key in draw_keys) for values in typed)
        columns[_DRAW] = [draws.setdefault(draw, str(len(draws) + 1)) for draw in drawn]
    totals = {"channels": "rmse", "inputs": "total_variation"}
    units = {group: c.unit for group, n in totals.items() if (c := result.columns.get(n))}
    figures = zip(*(column_of(rows, name) for name in FIGURE_COLUMNS), strict=True)
    about = [column_of(rows, name) for name in ("path", "outcome", "complete", "problem")]
    return [
        ComparisonRun(
            path=str(path),
            coordinates=dict(zip(columns, coordinates, strict=True)),
            state=_state(outcome, complete),
            figures=own,
            units=units,
            message=str(problem or ""),
        )
        for path, outcome, complete, problem, coordinates, own in zip(
            *about, zip(*columns.values(), strict=True), figures, strict=True
        )
    ]


def _state(outcome: str | None, complete: bool | None) -> State:
    from trms_cli.scoring.comparison.runs import State

    if outcome == "failed":
        return State.FAILED
    return State.DONE if complete else State.INCOMPLETE


def _coordinates(
    rows: Sequence[Mapping[str, Any]], typed: Sequence[Mapping[str, Any]], key: str
) -> list[str]:
    """A coordinate of each run: ``none`` for what was not chosen, – for a key it does not have."""
    values = sweeps.values_of(rows, typed, key)
    is_column = bool(rows) and key in rows[0]
    return [
        str(value) if value not in (None, "") else "none" if is_column or key in own else "–"
        for value, own in zip(values, typed, strict=True)
    ]


#: More runs than this are told as a sweep: curves over one another could not be told apart.
MOST_OVERLAID = 8
_MOST_DIFFERENCES = 60


@dataclass(frozen=True)
class Report:
    """What a page tells, and what it is of."""

    findings: Findings
    kind: Literal["run", "comparison", "sweep"]  #: ``run``, ``comparison`` or ``sweep``
    runs: tuple[str, ...]  #: Logs or folders of the runs in it
    folder: Path  #: Where it is written if nobody says otherwise
    left_out: tuple[tuple[str, str], ...] = ()  #: Files that could not be read, with the reason


def write_report(
    paths: Sequence[Path],
    *,
    out: Path | None = None,
    title: str = "",
    force: bool = False,
    quiet: bool = False,
) -> tuple[Report, Path]:
    """Write the page of logs and folders; the report, and where it is.

    Raises RecordingError if there is nothing to report, or the file exists and is not to be
    replaced.
    """
    from trms_cli.core.whole_file import refuse_overwrite, whole_file

    remedy = "--force replaces it; --out FILE.html names another"
    if out is not None and not force:
        refuse_overwrite(out, remedy)
    from trms_cli.reporting.page import page_html

    report = report_of(paths, title=title, out=out, quiet=quiet)
    path = out if out is not None else report.folder / sweeps.PAGE_NAME
    if not force:
        refuse_overwrite(path, remedy)
    with whole_file(path, force=force) as temporary:
        temporary.write_text(page_html(report.findings), encoding="utf-8")
    return report, path


def report_of(
    paths: Sequence[str | os.PathLike[str]],
    *,
    title: str = "",
    out: Path | None = None,
    quiet: bool = False,
    address: Callable[[str], str] | None = None,
) -> Report:
    """The report of logs, folders of a run, or folders of many, however deep.

    `title`: by default what ran. `out`: the file that the page will be written to, for links in it;
    by default ``report.html`` in the run's folder, in that of the sweep, or in the working folder
    for several paths. `quiet`: show no progress. `address`: where the page of each of many runs
    is, by its log, in the place of one beside the log. Raises RecordingError if a path does not
    exist, or there is nothing to report.
    """
    sources = [Path(path).expanduser() for path in paths]
    for path in sources:
        if not path.exists():
            raise absent(path, "file or folder")
    folder = _folder(sources)
    own = [log for path in sources if (log := _own_log(path)) is not None]
    logs = list({log.resolve(): log for log in own}.values())
    if len(own) == len(sources) and len(logs) <= MOST_OVERLAID:
        return _of_logs(logs, folder, title, [])
    result = sweeps.rows_of(
        [
            path if path.is_dir() else path.parent if path.name == LOG_NAME else path
            for path in sources
        ],
        quiet=quiet,
    )
    if not result.runs:
        return _of_scores(sources, result, folder, title)
    rows = [str(log) for log in column_of(result.runs, "log")]
    overlaid = all(log.endswith(".mcap") for log in rows) and len(rows) <= MOST_OVERLAID
    # Few runs of a sweep are a sweep still: each may be of another drawn rig, or a trial.
    if overlaid and not any(map(sweeps.sweep_document, sources)):
        return _of_logs([Path(log) for log in rows], folder, title, result.unreadable)
    page_folder = (out.parent if out is not None else folder).resolve()
    return _of_sweep(sources, result, folder, page_folder, title, address)


def _of_logs(
    logs: Sequence[Path], folder: Path, title: str, left_out: Sequence[tuple[str, str]]
) -> Report:
    from trms_cli.reporting.report_runs import findings_of_comparison, findings_of_run

    if len(logs) == 1:
        findings = findings_of_run(read_run(logs[0]), title=title)
        return Report(findings, "run", (str(logs[0]),), folder, tuple(left_out))
    names = _names(logs)
    runs: list[RunReport] = []
    trouble = list(left_out)
    for log, name in zip(logs, names, strict=True):
        try:
            runs.append(read_run(log, name=name))
        except RecordingError as error:
            trouble.append((str(log), error.problem))
    if not runs:
        raise RecordingError(
            f"none of the {len(logs)} logs can be read: {trouble[0][1]}", where=trouble[0][0]
        )
    findings = findings_of_comparison(
        runs, ranking=_ranking(logs), differences=_differences(runs), left_out=trouble, title=title
    )
    return Report(findings, "comparison", tuple(map(str, logs)), folder, tuple(trouble))


def _of_sweep(
    paths: Sequence[Path],
    result: QueryResult,
    folder: Path,
    page_folder: Path,
    title: str,
    address: Callable[[str], str] | None,
) -> Report:
    from trms_cli.reporting.report_sweep import findings_of_sweep

    typed = sweeps.typed_values(result.runs)
    sweep = sweeps.read_sweep(paths, result, page_folder, typed, address=address)
    # A search tries each set of weights once or a few times: its own objectives say which is best.
    draw_keys = drawn_keys(sweeps.sweep_document(paths[0])) if len(paths) == 1 else []
    ranking = None if sweep.objectives else ranking_of(runs_of_rows(result, draw_keys, typed))
    findings = findings_of_sweep(sweep, ranking=ranking, title=title)
    runs = tuple(map(str, column_of(result.runs, "path")))
    return Report(findings, "sweep", runs, folder, tuple(result.unreadable))


def _of_scores(paths: Sequence[Path], result: QueryResult, folder: Path, title: str) -> Report:
    """Folders without a log: scores alone, as tournaments leave them."""
    from trms_cli.reporting.report_sweep import findings_of_sweep
    from trms_cli.scoring.comparison.runs import gather

    if result.unreadable:
        file, problem = result.unreadable[0]
        raise RecordingError(
            f"no run here can be read: {problem}", where=file, remedy="a report is drawn from logs"
        )
    gathered = gather(paths)
    sweep, ranking = sweeps.from_scores(gathered, paths), ranking_of(gathered.runs)
    runs = tuple(run.path for run in gathered.runs)
    findings = findings_of_sweep(sweep, ranking=ranking, title=title)
    return Report(findings, "sweep", runs, folder, tuple(gathered.left_out))


def _ranking(logs: Sequence[Path]) -> Ranking | None:
    """The ranking of a few runs; None where they are not of one contest."""
    from trms_cli.scoring.comparison.runs import gather

    try:
        return ranking_of(gather(logs).runs)
    except RecordingError:  # imported recordings have no score
        return None


def _differences(runs: Sequence[RunReport]) -> list[tuple[str, list[str]]]:
    """Options and settings in which the runs differ, a value each."""
    from trms_cli.core.yaml_data import mapping_in
    from trms_cli.scoring.comparison.runs import differences

    options = dict.fromkeys(key for run in runs for key in run.choices)
    rows = [(key, [run.choices.get(key, "none") for run in runs]) for key in options]
    rows.append(("seed", [run.facts.get("seed", "–") for run in runs]))
    entries = [(key, values) for key, values in rows if len(set(values)) > 1]
    row_keys = {key for key, _ in rows}
    below = tuple(f"{key}." for key, _ in entries)
    configs = [mapping_in(run.config) for run in runs]
    settings: dict[str, dict[int, str]] = {}
    for i, config in enumerate(configs[1:], start=1):
        for key, first, other in differences(configs[0], config):
            if not key.startswith(below) and key not in row_keys:
                settings.setdefault(key, {0: first})[i] = other
    for key, values in list(settings.items())[:_MOST_DIFFERENCES]:
        entries.append((key, [values.get(i, values[0]) for i in range(len(runs))]))
    return entries


def _own_log(path: Path) -> Path | None:
    """The log that a path is, or the one of the run's folder that it is."""
    if path.is_file() and path.suffix != ".json":
        return path
    # a score stands beside the log that it is of
    log = (path if path.is_dir() else path.parent) / LOG_NAME
    return log if log.is_file() and not (path / sweeps.SWEEP_NAME).is_file() else None


def _folder(paths: Sequence[Path]) -> Path:
    if len(paths) > 1:
        return Path()
    return paths[0] if paths[0].is_dir() else paths[0].parent


def _names(logs: Sequence[Path]) -> list[str]:
    """Names of runs: their folders, with as much of the way to them as tells them apart."""
    names = [name_of(log) for log in logs]
    if len(set(names)) == len(names):
        return names
    paths = [str((log.parent if log.name == LOG_NAME else log).resolve()) for log in logs]
    root = os.path.commonpath(paths)
    relative_paths = [os.path.relpath(path, root) for path in paths]
    return [
        f"{name} ({i})" if relative_paths.count(name) > 1 else name
        for i, name in enumerate(relative_paths)
    ]
