"""The reference of a run: a signal for each controlled state, and what shapes them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cached_property
from itertools import cycle
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import require_known
from trms_cli.references.shaping import Shaping
from trms_cli.references.signal import Array, ReferenceSignal, require_signal

if TYPE_CHECKING:
    from trms_cli.models.model import Model

#: What the references that come with the program are for, in the order of the columns: angles of a
#: rig, speeds of a rotor that is alone on a bench. For a model without these their signals stand
#: for those of its own controlled states.
AXES = ("alpha_v", "alpha_h", "omega_v", "omega_h")
#: Fields of signals that are sizes; the others are times and numbers.
_SIZES = ("amplitude", "offset")
#: Share of the range of a state whose steady state is tried.
_SHARE = 0.5


@dataclass(frozen=True, init=False)
class ReferenceTrajectory:
    """What is to be followed: pitch and yaw, speeds of rotors, or a model's own controlled states.

    ``ReferenceTrajectory(alpha_v=Sine(…), shaping=None)``, with any other names as further keys. In
    the place of a signal under such a name, a mapping holds fields of the signal that
    :meth:`for_model` chooses, and as ``signal`` another one to choose.
    """

    #: Pitch, rad. ``None`` on a rig that turns in the horizontal plane only.
    alpha_v: ReferenceSignal | None = None
    #: Yaw, rad. ``None`` on a rig that moves in the vertical plane only.
    alpha_h: ReferenceSignal | None = None
    #: ``omega_v``, ``omega_h``: speeds of the main and the tail rotor, rad/s, where they are what
    #: is controlled
    omega_v: ReferenceSignal | None = None
    omega_h: ReferenceSignal | None = None
    #: Limits on the rate, acceleration and jerk of each; ``None`` leaves the signals as they are
    shaping: Shaping | None = None
    #: Those of a model's own names, in its units
    others: Mapping[str, Any] = field(default_factory=dict, repr=False)

    def __init__(
        self,
        *,
        alpha_v: ReferenceSignal | None = None,
        alpha_h: ReferenceSignal | None = None,
        omega_v: ReferenceSignal | None = None,
        omega_h: ReferenceSignal | None = None,
        shaping: Shaping | None = None,
        others: Mapping[str, Any] = MappingProxyType({}),
        **signals: Any,
    ) -> None:
        usual = dict(zip(AXES, (alpha_v, alpha_h, omega_v, omega_h), strict=True))
        others = {n: signal for n, signal in {**others, **signals}.items() if signal is not None}
        for name, value in {**usual, "shaping": shaping, "others": others}.items():
            object.__setattr__(self, name, value)
        if not self.signals:
            raise ConfigurationError(
                "a reference for no axis", where="alpha_v", remedy="give alpha_v, alpha_h or both"
            )
        for name, signal in self.signals.items():
            if not isinstance(signal, Mapping):
                require_signal(signal, name)
        if shaping is not None and not isinstance(shaping, Shaping):
            raise ConfigurationError(
                f"{type(shaping).__name__} is not a shaping",
                where="shaping",
                remedy="choose one of the group shaping, or null",
            )

    @property
    def signals(self) -> dict[str, Any]:
        """By name, those of the program's own names first."""
        usual = {axis: getattr(self, axis) for axis in AXES}
        return {name: s for name, s in usual.items() if s is not None} | dict(self.others)

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of what has a reference, in the order of the columns of a sample."""
        return tuple(n for n, signal in self.signals.items() if not isinstance(signal, Mapping))

    @cached_property
    def _shaped(self) -> tuple[ReferenceSignal, ...]:
        signals = tuple(self.signals[name] for name in self.axes)
        if self.shaping is None:
            return signals
        return tuple(self.shaping.apply(signal) for signal in signals)

    def sample(self, times: Array) -> Array:
        """References of all axes; the same for a time whatever other times are asked for.

        ``times``: (n,) s, in any order, as far ahead as a preview wants. Returns (n, len(axes)), in
        the units of what is controlled; columns as in :attr:`axes`.
        """
        times = np.asarray(times, dtype=float)
        return np.stack([signal.sample(times) for signal in self._shaped], axis=-1)

    def restricted_to(self, axes: Sequence[str]) -> ReferenceTrajectory:
        """The reference of a rig that has only these axes.

        Raises ConfigurationError if an axis of the rig has no reference.
        """
        for axis in axes:
            if axis not in self.axes:
                raise ConfigurationError(
                    f"the rig moves in {axis}, for which there is no reference",
                    where=axis,
                    remedy="choose ref=speed, which has references for speeds"
                    if axis.startswith("omega")
                    else f"choose one, e.g. signal@ref.{axis}=constant",
                )
        signals = {axis: self.signals[axis] for axis in (*AXES, *axes) if axis in axes}
        return ReferenceTrajectory(shaping=self.shaping, **signals)

    def for_model(self, model: Model) -> ReferenceTrajectory:
        """The reference of what a model controls.

        A model with names of its own has a signal of its own where one of that name is given.
        Elsewhere it has that of this reference (the first controlled state that of pitch, the next
        that of yaw) with its sizes as shares of :func:`usable_range`: 0.3 rad are 30 % of it.
        Fields that are given for the state are taken as they are, in its unit.

        Raises ConfigurationError for a name that is no state of the model.
        """
        for name, signal in self.signals.items():
            if name not in AXES or isinstance(signal, Mapping):
                states = model.controlled if isinstance(signal, Mapping) else model.state_names
                words = f"model {model.name!r} has no {name!r} that could follow a reference"
                require_known(name, states, words, name)
        own = [name for name in model.controlled if name not in AXES]
        signals = fitted_signals(self.signals, AXES, own, lambda name: usable_range(model, name))
        return ReferenceTrajectory(shaping=self.shaping, **signals).restricted_to(model.controlled)


def fitted_signals(
    signals: Mapping[str, Any],
    usual: Sequence[str],
    own: Sequence[str],
    ratio_of: Callable[[str], float],
) -> dict[str, Any]:
    """The signals, with one for each of a model's own names.

    Where none is given it is that of one of the usual names, in their order, or what a mapping has
    as ``signal``: its sizes times a ratio, and the other fields of the mapping as they are.
    """
    templates = [signals[name] for name in usual if name in signals]
    complete = dict(signals)
    missing = [name for name in own if isinstance(signals.get(name, {}), Mapping)]
    for name, template in zip(missing, cycle(templates), strict=False):
        given = dict(signals.get(name, {}))
        template = given.pop("signal", template)
        complete[name] = _with_fields(in_proportion(template, ratio_of(name)), given, name)
    return complete


def in_proportion(signal: Any, ratio: float) -> Any:
    """A signal with its sizes, and those of signals within, times a ratio."""
    if isinstance(signal, (tuple, list)):
        return tuple(in_proportion(item, ratio) for item in signal)
    if not is_dataclass(signal) or isinstance(signal, type):
        return signal
    changes: dict[str, Any] = {}
    for name in (entry.name for entry in fields(signal)):
        value = getattr(signal, name)
        if name in _SIZES:
            changes[name] = value * ratio
        elif isinstance(value, (tuple, list)) or is_dataclass(value):
            changes[name] = in_proportion(value, ratio)
    return replace(signal, **changes)


def _with_fields(signal: Any, given: Mapping[str, Any], where: str) -> Any:
    """A signal with the fields that are given."""
    allowed = [entry.name for entry in fields(signal)] if is_dataclass(signal) else []
    for key in given:
        words = f"unknown key {key!r} (given: {given[key]!r})"
        require_known(key, allowed, words, f"{where}.{key}")
    return replace(signal, **given) if given else signal


def usable_range(model: Model, name: str) -> float:
    """How far a controlled state of a model goes to either side, in its unit.

    To its mechanical stop, or without one as far as full command moves it; and no farther than its
    inputs can hold it.
    """
    from trms_cli.models.state_scales import scale_of_state
    from trms_cli.models.steady_state import SteadyState

    range_ = scale_of_state(model, name)
    wanted = np.zeros(len(model.controlled))
    wanted[model.controlled.index(name)] = _SHARE * range_
    target = SteadyState(model).solve(wanted)
    reached = abs(target.reference_reached[model.controlled.index(name)])
    if target.converged and target.projected and reached > 0:
        return float(reached)
    return range_
