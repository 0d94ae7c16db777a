"""What has been run, from Python: scored, compared, listed, opened again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from typing import TYPE_CHECKING, Any

from trms_cli.composition.arguments import path_of
from trms_cli.core.errors import RecordingError
from trms_cli.library import html
from trms_cli.library.result import RunPath, frame_of, run_paths

if TYPE_CHECKING:
    import pandas  # type: ignore[import-untyped,unused-ignore]


def score(*runs: RunPath, baseline: str | PathLike[str] | None = None) -> dict[str, Any]:
    """Metrics of runs: the document that ``trms score --json`` prints.

    Parameters
    ----------
    *runs : path or Run
        Logs, or folders of runs.
    baseline : path
        A baseline, or the score of another run as JSON: the document then has a ``comparison``
        with ``worse`` (bool) and ``figures``.

    Returns
    -------
    dict
        ``trms.score/1``; of several runs ``trms.scores/1``.

    Raises
    ------
    RecordingError
        If there is no log that can be read.

    Examples
    --------
    >>> score("outputs/first")["channels"]["alpha_h"]["rmse"]
    """
    from trms_cli.recordings.log_reader import read_log
    from trms_cli.runs.run_folder import log_of
    from trms_cli.scoring.baseline import compare as held_against
    from trms_cli.scoring.baseline import document_of, read_baseline
    from trms_cli.scoring.score import score_log

    if not runs:
        raise RecordingError("no run given", where="score", remedy='score("outputs/…/run.mcap")')
    file = None if baseline is None else path_of(baseline, "baseline")
    reference = None if file is None else read_baseline(file)
    scored = []
    for run in run_paths(runs):
        metrics = score_log(read_log(log_of(run)))
        scored.append((metrics, held_against(metrics, reference) if reference else None))
    return document_of(scored, file)


@dataclass(frozen=True, repr=False)
class Comparison:
    """Many runs ranked, or two side by side."""

    #: ``trms.compare/1``, or of two runs ``trms.compare_pair/1``: what ``--json`` prints
    document: dict[str, Any]

    @property
    def is_pair(self) -> bool:
        """Whether two runs stand side by side, without a ranking."""
        return "pair" in str(self.document["schema"])

    @cached_property
    def frame(self) -> pandas.DataFrame:
        """The table: a row an entrant with its figures; of two runs, a row a figure."""
        rows = [_flat(row) for row in self._rows]
        names = dict.fromkeys(name for row in rows for name in row)
        return frame_of({name: [row.get(name) for row in rows] for name in names}, {})

    @property
    def _rows(self) -> Sequence[Mapping[str, Any]]:
        rows: Sequence[Mapping[str, Any]] = self.document["figures" if self.is_pair else "entrants"]
        return rows

    @property
    def winner(self) -> str | None:
        """Who is first; None of two runs, which are not ranked."""
        if self.is_pair:
            return None
        return next((str(row["name"]) for row in self._rows if row.get("rank") == 1), None)

    def __repr__(self) -> str:
        return f"<Comparison of {len(self._rows)} {'figures' if self.is_pair else 'entrants'}>"

    def _repr_html_(self) -> str:
        rows = [_flat(row) for row in self._rows]
        names = list(dict.fromkeys(name for row in rows for name in row))
        cells = [[row.get(name) for name in names] for row in rows]
        return html.view(html.table(repr(self)[1:-1], names, cells))


def compare(
    *runs: RunPath | Sequence[RunPath],
    by: str | Sequence[str] = (),
    where: Mapping[str, Any] | None = None,
    metric: str = "rmse",
    sort: str = "rank",
) -> Comparison:
    """Tell which of many runs won, by how much, and how sure that is: ``trms compare``.

    Parameters
    ----------
    *runs : path or Run, or a sequence of them
        Logs, folders of runs and of sweeps, however deep.
    by : str or sequence of str
        Keys that name who ran; by default controller, observer and model.
    where : mapping
        Only these runs: ``{"ref": "sine"}``, ``{"seed": [1, 2]}``.
    metric : {"rmse", "iae", "ise", "itae", "max_abs_error"}
    sort : {"rank", "tracking", "worst", "effort", "variation", "time", "failures", "name"}

    Returns
    -------
    Comparison
        ``.document``, ``.frame``, ``.winner``.

    Raises
    ------
    RecordingError
        If there is nothing to compare.

    Examples
    --------
    >>> compare([run(controller=name) for name in ("pid", "lqr", "newton_mpc")])
    """
    from trms_cli.core.errors import ConfigurationError
    from trms_cli.core.plugins import nearest
    from trms_cli.library.tasks import compare as command

    for value, allowed, key in ((metric, command.METRICS, "metric"), (sort, command.SORTS, "sort")):
        if value not in allowed:
            raise ConfigurationError(f"{value!r} given", where=key, remedy=nearest(value, allowed))
    paths = list(run_paths(runs))
    filters = {key: _texts(value) for key, value in (where or {}).items()}
    gathered = command.runs_from(paths, filters)
    keys = [by] if isinstance(by, str) else list(by)
    if len(gathered.runs) == 2 and not keys:
        from trms_cli.scoring.comparison.findings import pair, pair_document

        return Comparison(pair_document(pair(*gathered.runs)))
    from trms_cli.scoring.comparison.findings import document

    ranking = command.ranking_of(gathered, keys, metric, paths)
    return Comparison(document(ranking, gathered, command.sort_standings(ranking, sort)))


def runs(
    filter: str = "", folders: RunPath | Sequence[RunPath] = (), **how: Any
) -> pandas.DataFrame:
    """What has been run, a row a run: ``trms runs``.

    Parameters
    ----------
    filter : str
        ``"controller == 'lqr' and rmse_yaw < 0.05"``.
    folders : path or sequence of paths
        Where to look, however deep; by default the working folder.
    **how
        ``everywhere=True``, ``sort=COLUMN``, ``descending=True``, ``columns=[…]``, ``limit=N``.

    Returns
    -------
    pandas.DataFrame
        Units in ``.attrs["units"]``.

    Raises
    ------
    TrmsError
        For a filter that cannot be used, and where pandas is not installed.

    Examples
    --------
    >>> runs("controller == 'lqr'", sort="rmse_yaw", limit=5)
    """
    from trms_cli.runs.frame import runs_frame

    return runs_frame(filter, folders, **how)


def _texts(value: Any) -> list[str]:
    several = value if isinstance(value, list | tuple | set) else [value]
    return [str(item) for item in several]


def _flat(row: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """One level: ``solver.time_ms``."""
    fields: dict[str, Any] = {}
    for key, value in row.items():
        if isinstance(value, Mapping):
            fields |= _flat(value, f"{prefix}{key}.")
        elif not isinstance(value, list):
            fields[f"{prefix}{key}"] = value
    return fields
