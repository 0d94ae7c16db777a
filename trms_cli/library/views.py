"""Pages and figures of runs from Python."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from trms_cli.composition.arguments import path_of
from trms_cli.core.errors import ConfigurationError
from trms_cli.library.call import turn
from trms_cli.library.result import RunPath, run_paths

if TYPE_CHECKING:
    from trms_cli.reporting.style import NotebookFigure


def report(
    *runs: RunPath | Sequence[RunPath],
    out: str | PathLike[str] | None = None,
    title: str = "",
    force: bool = False,
    verbose: bool = False,
) -> Path:
    """Write one self-contained page of a run, of several, or of a sweep: ``trms report``.

    Parameters
    ----------
    *runs : path or Run, or a sequence of them
        Logs, folders of runs, the folder of a sweep.
    out : path
        The page, ``*.html``; by default ``report.html`` beside what it is of.
    title : str
    force : bool
        Whether a page that is there may be replaced.
    verbose : bool
        Show progress.

    Returns
    -------
    Path
        The page; it needs no network, and can be sent as it is.

    Raises
    ------
    RecordingError
        If there is nothing to report, or the page exists.

    Examples
    --------
    >>> report(lqr, pid, out="comparison.html")
    """
    from trms_cli.library.report.pages import write_report

    with turn("Python: report"):
        page = None if out is None else path_of(out, "out")
        return write_report(
            list(run_paths(runs)), out=page, title=title, force=force, quiet=not verbose
        )[1]


def plot(
    *runs: RunPath | Sequence[RunPath],
    what: str | Sequence[str] = ("tracking", "inputs"),
    width: str | None = None,
    style: str = "screen",
    start: float | None = None,
    end: float | None = None,
    title: str = "",
    names: Sequence[str] | None = None,
) -> NotebookFigure:
    """Draw runs into one figure: ``trms plot``.

    Parameters
    ----------
    *runs : path or Run, or a sequence of them
        Several are laid over each other.
    what : str or sequence of str
        ``"tracking"``, ``"errors"``, ``"inputs"``, ``"rates"``, ``"estimate"``, ``"phase"``,
        ``"prediction"``, ``"solver"``, ``"torques"``, ``"comparison"``.
    width : str
        ``"89mm"`` (a column), ``"183mm"`` (a page), ``"120x80mm"``.
    style : {"screen", "paper", "slides"}
    start, end : float
        What is drawn of the run, s.
    title : str
    names : sequence of str
        Of the runs; what they differ in by default.

    Returns
    -------
    matplotlib.figure.Figure
        Shown by a notebook; ``figure.savefig("figure2.pdf")`` keeps it.

    Raises
    ------
    ConfigurationError
        For an unknown kind, or one of which the runs have nothing.

    Examples
    --------
    >>> plot(lqr, pid, what=["tracking", "errors"], start=5, end=15)
    """
    from trms_cli.recordings.log_reader import read_log
    from trms_cli.reporting.plot import plot as draw_runs
    from trms_cli.reporting.style import figure_for_notebook
    from trms_cli.runs.run_folder import log_of

    if "scene" in ([what] if isinstance(what, str) else what):
        raise ConfigurationError(
            "a scene is drawn on the command line only",
            where="what",
            remedy="trms plot LOG --what scene",
        )
    logs = [read_log(log_of(path)) for path in run_paths(runs)]
    variant: Any = style
    return figure_for_notebook(
        draw_runs(
            logs, what, width=width, style=variant, start=start, end=end, title=title, names=names
        )
    )
