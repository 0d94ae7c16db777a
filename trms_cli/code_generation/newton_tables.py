"""Sizes, tables and settings of an exported Newton MPC, read off a controller that is ready."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from trms_cli.code_generation.literals import number, numbers, table, text, whole_table
from trms_cli.models.model import names

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class SettingField:
    """A field of the settings struct."""

    declaration: str  #: As C declares it
    value: str  #: Its initialiser
    comment: str


def sizes(state: Any, preview: int) -> dict[str, tuple[int, str]]:
    """Sizes by macro (without prefix), each with what it counts."""
    model, horizon = state.model, state.newton.horizon
    rates = np.isfinite(_largest_moves(state))
    terminal = model.n_x if horizon.terminal is not None else 0
    n_z, n_rate = horizon.n_z, int(rates.sum()) * horizon.n_blocks
    rows, soft = terminal + n_rate, len(horizon.limited) * horizon.n_periods
    steady = len(state.steady_state.unknowns)
    return {
        "N_X": (model.n_x, "states: " + _units(model.states)),
        "N_U": (model.n_u, "inputs: " + _units(model.inputs)),
        "N_W": (model.n_w, "torques: " + _units(model.disturbances)),
        "N_R": (len(model.controlled), "controlled: " + ", ".join(model.controlled)),
        "N_P": (len(model.parameters), "parameters of the model"),
        "N": (horizon.n_periods, "control periods ahead"),
        "PREVIEW": (preview, "control periods that the reference is known ahead"),
        "FORECAST": (_forecast(state), "periods that an unknown reference is carried on for"),
        "N_FULL": (state.discrete.n_x, "states, and what is remembered of past commands"),
        "N_S": (steady, "unknowns of a steady state"),
        "N_BLOCKS": (horizon.n_blocks, "blocks of constant inputs"),
        "N_Z": (n_z, "unknowns: N_U inputs in each block"),
        "N_WEIGHTED": (len(horizon.weighted), "states with a weight"),
        "N_DAMPED": (len(horizon.damped), "angles with a weight on their rate"),
        "N_LIMITED": (len(horizon.limited), "states with soft limits"),
        "N_TERMINAL": (terminal, "states that end in the steady state"),
        "RATES_LIMITED": (int(rates.any()), "whether an input's rate is limited"),
        "ROWS": (rows, "rows of the quadratic program beside the bounds"),
        "ROWS_SOFT": (soft, "further rows, of the soft limits"),
        "ROWS_LIMITED": (rows + soft, "all rows"),
        "QP_ACTIVE": (n_z + terminal + soft + 1, "constraints that may be active at once"),
        "QP_ITERATIONS": (state.config.qp.max_iterations, "changes of the active set at the most"),
    }


def tables(state: Any) -> str:
    """Constants that no setting may change: what belongs to what."""
    model, horizon, steady = state.model, state.newton.horizon, state.steady_state
    limits = state.config.soft_limits
    sources = [
        model.controlled.index(name) if name in model.controlled else -1
        for name in horizon.weighted
    ]
    goals = [horizon.limited.index(name) if name in limits else -1 for name in model.controlled]
    full = state.discrete.initial(model.rest(), np.zeros(model.n_u))
    rows = {
        "mpc_block": horizon.blocks,
        "mpc_periods": np.bincount(horizon.blocks),
        "mpc_weighted_row": [model.state_index(name) for name in horizon.weighted],
        "mpc_weighted_reference": sources,
        "mpc_damped_row": [model.state_index(name) for name in horizon.damped],
        "mpc_damped_reference": [model.controlled.index(name) for name in horizon.damped],
        "mpc_limited_row": [model.state_index(name) for name in horizon.limited],
        "mpc_goal_limit": goals,
        "mpc_steady_rows": steady.unknowns,
        "mpc_steady_controlled": steady.controlled,
    }
    whole = [whole_table(name, values) for name, values in rows.items()]
    rates = np.isfinite(_largest_moves(state))
    if rates.any():
        whole.append(whole_table("mpc_rate_limited", rates.astype(int)))
    return "\n".join(
        [
            *whole,
            table("mpc_steady_rest", model.rest()[list(steady.unknowns)]),
            table("mpc_full_rest", full),
        ]
    )


def settings(state: Any) -> list[SettingField]:
    """What may be changed between two steps, with its exported values."""
    model, horizon, config = state.model, state.newton.horizon, state.config
    at = horizon.arguments
    lower, upper = model.input_bounds()
    moves = np.where(np.isfinite(_largest_moves(state)), _largest_moves(state), 0.0)
    inputs, n = names(model.inputs), len(horizon.weighted)
    tracked = ", ".join(model.controlled)
    stops = [model.stops.get(name, np.inf) for name in model.controlled]

    def vector(name: str, size: str, values: npt.ArrayLike, comment: str) -> SettingField:
        return SettingField(f"double {name}[{size}]", numbers(values), comment)

    return [
        vector("p", "MPC_ROOM(MPC_N_P)", at["p"], "parameters, see the source for their names"),
        vector(
            "state_weights",
            "MPC_ROOM(MPC_N_WEIGHTED)",
            at["q"][:n],
            "1/unit^2, of the deviation of " + ", ".join(horizon.weighted),
        ),
        vector(
            "rate_weights",
            "MPC_ROOM(MPC_N_DAMPED)",
            at["q"][n:],
            "s^2/unit^2, of the mean rate, less the reference's, of " + ", ".join(horizon.damped),
        ),
        vector("input_weights", "MPC_N_U", at["rho"], "1/V^2, of " + ", ".join(inputs)),
        vector("move_weights", "MPC_N_U", at["s"], "1/V^2, of the change between blocks"),
        SettingField(
            "double soft_limits[MPC_ROOM(MPC_N_LIMITED)][2]",
            "{" + ", ".join(numbers(row) for row in at["limits"]) + "}"
            if horizon.limited
            else "{{0, 0}}",
            "lower and upper, states' units, of " + (", ".join(horizon.limited) or "none"),
        ),
        *(
            SettingField(f"double {name}", number(value), comment)
            for name, value, comment in (
                ("soft_linear", at["prices"][2], "price of violating them, 1/unit"),
                ("soft_quadratic", at["prices"][3], "1/unit^2"),
                ("terminal_linear", at["prices"][0], "price of missing the steady state"),
                ("terminal_quadratic", at["prices"][1] or 1.0, "the same, of the square"),
            )
        ),
        vector("scale", "MPC_N_X", at["scale"], "typical sizes of the states, in their units"),
        vector("lower", "MPC_N_U", lower, "V, limits of the inputs"),
        vector("upper", "MPC_N_U", upper, "V; steady states take them for -lower"),
        vector("largest_moves", "MPC_N_U", moves, "V in a control period, where rates are limited"),
        vector(
            "steady_weights", "MPC_N_R", state.steady_state.weights, f"of {tracked} out of reach"
        ),
        vector("stops", "MPC_N_R", stops, f"rad, mechanical ranges of {tracked}, +-"),
        SettingField(
            "double tolerance", number(config.tolerance), "V, converged when no input moves more"
        ),
        SettingField(
            "int max_iterations", str(config.max_iterations), "Newton iterations of a start"
        ),
    ]


def parameter_comments(state: Any) -> str:
    """The parameters by position: name, value, unit, description."""
    lines = [
        f" *   p[{i:2d}] {p.name} = {p.value:g} {p.unit}"
        + (f": {p.description}" if p.description else "")
        for i, p in enumerate(state.model.parameters)
    ]
    return "/* Parameters of the model:\n" + "\n".join(map(text, lines)) + "\n */"


def _forecast(state: Any) -> int:
    config = state.config
    if config.preview_horizon:
        return 0
    return min(config.forecast_horizon, config.prediction_horizon)


def _largest_moves(state: Any) -> FloatArray:
    """V in a control period, infinite where the rate is free."""
    limits = state.config.input_rate_limits
    rates = [limits.get(name, np.inf) for name in names(state.model.inputs)]
    return np.array(rates) * state.discrete.step_length


def _units(signals: Any) -> str:
    return ", ".join(text(f"{signal.name} [{signal.unit}]") for signal in signals)
