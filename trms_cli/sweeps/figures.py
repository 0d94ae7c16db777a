"""Figures of a run by the names that ``trms runs`` has for them, as samplers are told of them."""

from collections.abc import Collection, Iterable, Mapping
from difflib import get_close_matches

from trms_cli.core.errors import ConfigurationError
from trms_cli.runs.columns import ALIASES, COLUMNS, figure_stems
from trms_cli.scoring.figures import of_group
from trms_cli.sweeps.space import RunResult

#: What a command itself calls its figure of merit: the cost of ``trms identify``, …
MERIT = "merit"
#: Likeness from which on a name is rather another one misspelt than that of an unknown channel.
_MISSPELT = 0.85
#: Likeness from which on a figure may have been meant, and how many of those are told.
_NEAR, _MOST_NEAR = 0.6, 3


def canonical(name: str, where: str) -> str:
    """The name that a score has for a figure: ``rmse_alpha_h`` for ``rmse_yaw``.

    Raises ConfigurationError if there is no figure of that name.
    """
    figure = ALIASES.get(name, name)
    column = COLUMNS.get(figure)
    if figure == MERIT or (column is not None and column.is_number):
        return figure
    said = [*with_aliases(n for n, each in COLUMNS.items() if each.is_number), MERIT]
    of_channel = column is None and any(figure.startswith(f"{stem}_") for stem in figure_stems())
    if of_channel and not get_close_matches(figure, said, n=1, cutoff=_MISSPELT):
        return figure  # of a channel that the twin rotor does not have
    raise ConfigurationError(
        f"runs have no figure {name!r}", where=where, remedy=near_figures(name, said)
    )


def near_figures(name: str, figures: Iterable[str]) -> str:
    """A remedy: the few figures that may have been meant, and where all of them are told.

    ``figures``: figures that there are, by any of their names.
    """
    close = get_close_matches(name, sorted({*figures}), n=_MOST_NEAR, cutoff=_NEAR)
    hint = f"did you mean {' or '.join(close)}? " if close else ""
    return f"{hint}all figures: trms runs --help"


def objective_name(name: str, typed: Iterable[str]) -> str:
    """A figure as it was typed, ``rmse_yaw``, given the name that scores have for it."""
    return next((each for each in typed if ALIASES.get(each, each) == name), name)


def with_aliases(names: Iterable[str]) -> list[str]:
    """Figures by their names in scores, and by those that are typed for them."""
    figures = list(names)
    return [*figures, *(typed for typed, figure in ALIASES.items() if figure in figures)]


def canonical_all(names: Iterable[str], where: str) -> tuple[str, ...]:
    """The names of several figures, each once; see :func:`canonical`."""
    return tuple(dict.fromkeys(canonical(name, where) for name in names))


def canonical_limits(limits: Mapping[str, float], where: str) -> dict[str, float]:
    """Limits by the names that scores have; see :func:`canonical`."""
    return {canonical(name, f"{where}.{name}"): float(bound) for name, bound in limits.items()}


def figure_of(result: RunResult, name: str) -> float | None:
    """A figure of a run that is done, None where it has none or is not done.

    ``name``: as :func:`canonical` gives it.
    """
    if result.state != "done":
        return None
    if name == MERIT:
        return result.objective
    value = result.figures.get(name)
    if value is None:
        said = next((n for n, figure in ALIASES.items() if figure == name), name)
        value = result.figures.get(said)
    return value


def unit_of(name: str, figures: Collection[str] = ()) -> str:
    """Unit of a figure; "" for counts and for what is not known.

    ``figures``: those of runs; what is added over channels of another rig has its own unit.
    """
    column = COLUMNS.get(name)
    is_total = any(f.total and f.column_name == name for f in of_group("channels", "inputs"))
    own = tracking_errors(figures)
    if column is None or (is_total and own and not any(each in COLUMNS for each in own)):
        return ""
    return column.unit


def tracking_errors(figures: Iterable[str]) -> list[str]:
    """Those of some figures that are RMS tracking errors of a channel."""
    return sorted(name for name in figures if name.startswith("rmse_"))
