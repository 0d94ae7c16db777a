"""What the optimisation of the Newton MPC is about: weights, limits, prices, blocks of inputs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import nearest
from trms_cli.models.model import Model, names


@dataclass(frozen=True)
class Weights:
    """Weights of the objective, by state or input name."""

    #: q: of the squared deviation of a state, 1/unit². A controlled angle deviates from its
    #: reference, any other state from its value at the steady-state target.
    states: Mapping[str, float]
    #: d: of the squared mean rate of a controlled angle over each control period, less that of a
    #: reference that moves smoothly, s²/unit². It damps the motion itself; a weight on the angular
    #: momentum S would also punish the momentum that holds an axis still while the other axis'
    #: rotor changes its speed.
    rates: Mapping[str, float]
    inputs: Mapping[str, float]  #: ρ: of the squared deviation from the steady-state input, 1/V²
    moves: Mapping[str, float]  #: s: of the squared change between successive blocks, 1/V²


@dataclass(frozen=True)
class SoftLimits:
    """Limits on states that may be violated at a price."""

    states: Mapping[str, tuple[float, float]]  #: Lower and upper limit, in the state's unit
    #: ``linear``, ``quadratic``: μ and ν: price of a violation, 1/unit and 1/unit²
    linear: float
    quadratic: float


@dataclass(frozen=True)
class TerminalPrice:
    """Price of missing the terminal constraint (see :class:`Horizon`).

    That is the terminal equality, in scaled units, or a terminal region, in the root of the
    objective's.
    """

    linear: float  #: μ
    quadratic: float  #: ν
    #: Whether the horizon ends in a region with a cost of its own instead of the steady state.
    region: bool = False


def blocks_of(prediction_horizon: int, lengths: tuple[int, ...]) -> npt.NDArray[np.int64]:
    """Block index of each control period, shape (N,).

    Blocks beyond the horizon are left out; the last one lasts to its end.

    Raises ConfigurationError if there is no block, or one of no length.
    """
    if not lengths or min(lengths) < 1:
        raise ConfigurationError(
            f"{list(lengths)!r} given",
            where="move_blocks",
            remedy="one length or more, each of at least 1 control period",
        )
    index = np.repeat(np.arange(len(lengths)), lengths)[:prediction_horizon]
    rest = np.full(prediction_horizon - len(index), index[-1])
    return np.concatenate([index, rest])


def check_problem(model: Model, weights: Weights, limits: SoftLimits) -> None:
    """Raise :class:`ConfigurationError` for a limit or a name that makes no sense."""
    inputs = names(model.inputs)
    for name, (lower, upper) in limits.states.items():
        if not lower < upper:
            raise ConfigurationError(
                f"[{lower:g}, {upper:g}] given",
                where=f"soft_limits.{name}",
                remedy="the lower limit first, and below the upper one",
            )
    for where, given, known in (
        ("state_weights", weights.states, model.state_names),
        ("rate_weights", weights.rates, model.controlled),
        ("input_weights", weights.inputs, inputs),
        ("move_weights", weights.moves, inputs),
        ("soft_limits", limits.states, model.state_names),
    ):
        check_names(given, known, where)


def check_names(given: Iterable[str], known: Sequence[str], where: str) -> None:
    """Raise :class:`ConfigurationError` for a name that neither this model nor its kin has."""
    for name in given:
        if name not in known and not _of_other_axis(name):
            raise ConfigurationError(
                f"the model has no {name!r}", where=f"{where}.{name}", remedy=nearest(name, known)
            )


def _of_other_axis(name: str) -> bool:
    """Names of the 2 DOF rig, so that one configuration also serves its 1 DOF models."""
    return name in {"alpha_v", "alpha_h", "S_v", "S_h", "omega_v", "omega_h", "u_v", "u_h"}
