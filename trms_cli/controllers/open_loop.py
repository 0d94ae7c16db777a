"""No control: signals are played as commands, to see what a rig does with them.

    u(t) = u₀ + s(t), cut to the input's limits

with u₀ = 0, or the command that holds the model at an operating point. References have no part in
it: none is logged, and no tracking error is scored.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np

from trms_cli.controllers.controller import (
    Command,
    ControlSample,
    ControlSetup,
    FloatArray,
    PresentReference,
)
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import require_known
from trms_cli.models.model import names
from trms_cli.models.state_scales import bench_ratios
from trms_cli.models.steady_state import SteadyState
from trms_cli.references.signal import ReferenceSignal, require_signal
from trms_cli.references.trajectory import fitted_signals

#: Inputs that have signals in the program's own YAML.
_ROTORS = ("u_v", "u_h")
#: Samples for which the signals are evaluated at once.
_BLOCK = 1024


@dataclass
class OpenLoopState:
    """What a run of it needs."""

    period: float  #: Between two commands, s
    signals: list[ReferenceSignal | None]  #: By input; None rests
    offset: FloatArray  #: u₀, (n_u,)
    lower: FloatArray  #: The limits, (n_u,)
    upper: FloatArray  #: (n_u,)
    units: list[str]  #: Of the inputs
    names: list[str]
    block: int = -1  #: Which run of samples is at hand
    #: (n, n_u) array; what is asked for in it
    commands: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    def command_at(self, time: float) -> FloatArray:
        """What the signals ask for at a time (s), before limits, shape (n_u,)."""
        block, k = divmod(round(time / self.period), _BLOCK)
        if block != self.block:
            times = (block * _BLOCK + np.arange(_BLOCK, dtype=np.float64)) * self.period
            self.commands = np.tile(self.offset, (_BLOCK, 1))
            for column, signal in zip(self.commands.T, self.signals, strict=True):
                if signal is not None:
                    column += signal.sample(times)
            self.block = block
        return self.commands[k]


@dataclass(frozen=True, init=False)
class OpenLoop(PresentReference):
    """Signals as commands. All amplitudes and offsets of the signals are in the input's unit.

    A model whose inputs have names of their own takes signals by these as further keys; an input
    without one has that of the main or the tail rotor, with its sizes by the scale of the input:
    0.5 V are 20 % of full command.
    """

    u_v: ReferenceSignal | None = None  #: What the main and the tail rotor are told, beyond u₀
    u_h: ReferenceSignal | None = None  #: None: nothing
    #: Angles (rad) at which the model rests with u₀; those not named rest at zero. None: u₀ = 0.
    operating_point: Mapping[str, float] | None = None
    sample_time: float | None = None  #: Period of the commands, s; None takes every sample

    #: Nothing is to be followed: no reference in the log, no tracking error in the score.
    follows_reference: ClassVar[bool] = False

    #: Those of inputs of other names
    others: Mapping[str, Any] = field(default_factory=dict, repr=False)

    def __init__(
        self,
        *,
        u_v: ReferenceSignal | None = None,
        u_h: ReferenceSignal | None = None,
        operating_point: Mapping[str, float] | None = None,
        sample_time: float | None = None,
        others: Mapping[str, Any] = MappingProxyType({}),
        **signals: Any,
    ) -> None:
        values: dict[str, Any] = {"u_v": u_v, "u_h": u_h, "others": {**others, **signals}}
        values |= {"operating_point": operating_point, "sample_time": sample_time}
        for name, value in values.items():
            object.__setattr__(self, name, value)
        for name, signal in self._signals.items():
            if not isinstance(signal, Mapping):
                require_signal(signal, name)

    @property
    def _signals(self) -> dict[str, Any]:
        signals = {"u_v": self.u_v, "u_h": self.u_h, **self.others}
        return {name: signal for name, signal in signals.items() if signal is not None}

    def init(self, setup: ControlSetup) -> OpenLoopState:
        """A fresh state.

        Raises ConfigurationError if the model cannot rest at the operating point.
        """
        model = setup.model
        inputs = names(model.inputs)
        lower, upper = model.input_bounds()
        for name in self.others:
            words = f"model {model.name!r} has no input {name!r}"
            require_known(name, inputs, words, f"controller.{name}")
        ratios = dict(zip(inputs, bench_ratios(model).inputs.tolist(), strict=True))
        own = [name for name in inputs if name not in _ROTORS]
        signals = fitted_signals(self._signals, _ROTORS, own, ratios.__getitem__)
        return OpenLoopState(
            setup.sample_time,
            [signals.get(name) for name in inputs],
            self._resting_command(setup),
            lower,
            upper,
            [signal.unit for signal in model.inputs],
            list(inputs),
        )

    def step(
        self, state: OpenLoopState, sample: ControlSample, *, want_prediction: bool
    ) -> Command:
        """The signals' values now; the message says what was cut."""
        u = state.command_at(sample.time)
        cut = np.clip(u, state.lower, state.upper)
        message = ""
        if not np.array_equal(cut, u):
            message = ", ".join(
                f"{name} cut from {value:.4g} to {cut_value:.4g} {unit}"
                for name, value, cut_value, unit in zip(
                    state.names, u, cut, state.units, strict=True
                )
                if value != cut_value
            )
        return Command(cut, message=message)

    def _resting_command(self, setup: ControlSetup) -> FloatArray:
        model = setup.model
        if self.operating_point is None:
            return np.zeros(model.n_u)
        for name, value in self.operating_point.items():
            problem = f"{name!r} is no angle of model {model.name!r}"
            require_known(name, model.controlled, problem, f"operating_point.{name}")
            if not math.isfinite(value):
                raise ConfigurationError(
                    f"{value!r} given", where=f"operating_point.{name}", remedy="an angle in rad"
                )
        angles = np.array([self.operating_point.get(name, 0.0) for name in model.controlled])
        target = SteadyState(model).solve(angles)
        if not target.exact:
            reached = ", ".join(
                f"{name} {value:.3g} rad"
                for name, value in zip(model.controlled, target.reference_reached, strict=True)
            )
            raise ConfigurationError(
                f"model {model.name!r} cannot rest there",
                where="operating_point",
                remedy=f"the nearest point at which it rests: {reached}",
            )
        return np.array(target.u)
