"""What is varied and over which range, as asked for."""

from __future__ import annotations

from collections.abc import Mapping

from trms_cli.core.errors import ConfigurationError
from trms_cli.models.model import Model, names
from trms_cli.models.operating_point import asked_by_angle


def line_of(model: Model, at: Mapping[str, float], over: str | None, usual: str) -> str:
    """What is varied: what is asked for; the first command held, if commands are; the usual.

    Parameters
    ----------
    at : dict of str to float
        Angles (rad) or commands (V) that are held.
    over : str or None
        What is asked for.
    usual : str
        What is varied when nothing is said.

    Raises
    ------
    ConfigurationError
        For an angle where commands are held, and the reverse; for names in ``at`` that are
        neither, or of both kinds.
    """
    if not at:
        return over or usual
    by_angle = asked_by_angle(model, at)
    if over is None:
        return usual if by_angle else next(iter(at))
    kinds = {True: ("an angle", model.controlled), False: ("a command", names(model.inputs))}
    if over in kinds[not by_angle][1]:
        use = next(iter(at))
        raise ConfigurationError(
            f"over={over} varies {kinds[not by_angle][0]}; at holds "
            f"{'angles' if by_angle else 'commands'} ({', '.join(at)})",
            where="study.over",
            remedy=f"use study.over={use}, or give {'commands' if by_angle else 'angles'} in at",
        )
    return over


def in_order(given: tuple[float, float], where: str) -> tuple[float, float]:
    """A range as given.

    Raises ConfigurationError for one that is empty or reversed.
    """
    low, high = given
    if low == high:
        raise ConfigurationError(
            f"{list(given)} given", where=where, remedy="give two different numbers"
        )
    if not low < high:
        raise ConfigurationError(
            f"{list(given)} given: the upper end comes first",
            where=where,
            remedy=f"give the lower end first: '{where}=[{high:g},{low:g}]'",
        )
    return low, high
