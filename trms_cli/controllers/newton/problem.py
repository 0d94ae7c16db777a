"""What a Newton MPC's configuration poses for a model: the problem that every engine solves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from trms_cli.controllers.controller import ControlSetup
from trms_cli.controllers.horizon import (
    Horizon,
    SoftLimits,
    TerminalPrice,
    Weights,
    blocks_of,
    check_names,
)
from trms_cli.core.arrays import FloatArray
from trms_cli.core.c_source import SettingField
from trms_cli.core.compilation import BufferedFunction
from trms_cli.models.discretisation import DiscreteModel, discretise
from trms_cli.models.model import Model, names
from trms_cli.models.state_scales import state_scales
from trms_cli.models.steady_state import SteadyState
from trms_cli.models.vector_field import holds_at_rest

if TYPE_CHECKING:
    from trms_cli.controllers.linear_mpc import LinearMpc
    from trms_cli.controllers.newton_mpc import NewtonMpc

#: Least weights (1/V²) of the rotors' inputs, of their deviation from the steady state, for a model
#: whose friction holds an axis. Inside the friction's cone an input moves nothing and nothing else
#: prices it: it would drift to the cone's edge, where the axis slips at the least error of the
#: estimate, or serve the other axis at every whim of its noise. As large as
#: tracking bears: sines are followed as without (measured: docs/closing-the-loop.md).
_HOLDING_WEIGHTS = {"main": 2e-3, "tail": 3e-5}


class NewtonProblem:
    """The problem of a configuration for a model.

    ``horizon``: with its weights, limits and prices; nothing of it is compiled yet. ``discrete``:
    one control period. ``steady_state``: targets. ``largest_moves``: (n_u,); largest change of an
    input in one control period, V; infinite for none. ``goal_limits``: (n_r, 2); soft limits of
    what is controlled, beyond which no target lies; None without any.

    Raises ConfigurationError for names and limits that the model does not have.
    """

    name = "newton_mpc"  #: Of the controller, for messages
    #: What else its C has of settings: numbers, then whole ones.
    further_settings: tuple[SettingField, ...] = ()
    further_switches: tuple[SettingField, ...] = ()

    def __init__(self, config: NewtonMpc, setup: ControlSetup) -> None:
        model = setup.model
        config = config.for_model(model)
        self.discrete = discretise(model, setup.sample_time, config.integration_steps)
        sizes = typical_sizes(self.discrete)
        weights = _tracking(model, config.state_weights, sizes)
        self.set_limits(config, setup, weights)
        # The plan may end at any value of what remembers the path: none of it is missed.
        sizes[list(model.path_memory)] = np.inf
        self._terminal_sizes = sizes
        input_weights = dict(config.input_weights)
        if holds_at_rest(model):
            for name, rotor in model.rotors.items():
                least = _HOLDING_WEIGHTS.get(name, 0.0)
                input_weights[rotor.input] = max(input_weights.get(rotor.input, 0.0), least)
        self._weights = Weights(weights, config.rate_weights, input_weights, config.move_weights)
        self._price = (
            None
            if config.terminal == "none"
            else TerminalPrice(
                config.terminal_linear,
                config.terminal_quadratic,
                cost=config.terminal != "contractive",
            )
        )
        self.horizon = self.horizon_ending(in_region=config.terminal not in ("equality", "none"))

    def set_limits(
        self, config: NewtonMpc | LinearMpc, setup: ControlSetup, weights: Mapping[str, float]
    ) -> None:
        """What does not depend on the prediction: blocks, targets, limits of rates and goals."""
        model = setup.model
        self.config, self.model = config, model
        self._blocks = blocks_of(config.prediction_horizon, tuple(config.move_blocks))
        self.steady_state = SteadyState(model, {name: q for name, q in weights.items() if q > 0})
        inputs = names(model.inputs)
        check_names(config.input_rate_limits, inputs, "input_rate_limits")
        rates = np.array([config.input_rate_limits.get(name, np.inf) for name in inputs])
        self.largest_moves = rates * setup.sample_time
        limits = [config.soft_limits.get(name, (-np.inf, np.inf)) for name in model.controlled]
        self.goal_limits = np.array(limits) if config.soft_limits else None

    def horizon_ending(self, *, in_region: bool) -> Horizon:
        """The horizon that ends in a terminal region, or as configured in the steady state."""
        config = self.config
        return Horizon(
            self.discrete,
            self._blocks,
            self._weights,
            SoftLimits(config.soft_limits, config.soft_linear, config.soft_quadratic),
            self._price and replace(self._price, region=in_region),
            self._terminal_sizes,
        )


def typical_sizes(discrete: DiscreteModel) -> FloatArray:
    """How far each state of a model moves within seconds under full inputs, shape (n_x,).

    From rest, each input is held at either limit; the largest excursion counts. It makes one
    terminal price serve angles (rad) and rotor speeds (hundreds of rad/s) alike.
    """
    model = discrete.model
    if not model.bench_sizes:  # which may be unstable: a pendulum turns round in that time
        return state_scales(model).states.copy()
    step = BufferedFunction(discrete.step)
    sizes = np.full(model.n_x, 1e-3)
    lower, upper = model.input_bounds()
    for i in range(model.n_u):
        for bound in (lower[i], upper[i]):
            u = np.zeros(model.n_u)
            u[i] = bound
            start = discrete.initial(model.rest(), np.zeros(model.n_u))
            x = start.copy()
            for _ in range(max(1, round(2.0 / discrete.step_length))):
                x[:] = step.evaluate(x, u, model.parameters.values, np.zeros(model.n_w))[0]
                if not np.isfinite(x).all():
                    break
                sizes = np.maximum(sizes, np.abs(x - start)[: model.n_x])
    return sizes


def _tracking(model: Model, weights: Mapping[str, float], sizes: FloatArray) -> Mapping[str, float]:
    """The weights given, with those of what is controlled where none of them is named.

    The usual weights are of angles. A rotor alone on a bench is controlled in its speed, whose
    deviation then counts as a share of its typical size, as a radian does.
    """
    if any(name in weights for name in model.controlled):
        return weights
    return {
        **weights,
        **{name: sizes[model.state_index(name)] ** -2.0 for name in model.controlled},
    }
