"""The C of a Newton MPC: templates, tables and generated functions in one.

The same source is the engine of ``controller=newton_mpc``
(:mod:`trms_cli.controllers.newton.engine`) and what ``trms export-controller`` writes. Sizes and
tables are read off a problem; CasADi's functions stand inside as static ones. What belongs to a
tuning alone is a field of the settings: one compiled source serves every tuning of one structure.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import casadi as ca
import numpy as np
import numpy.typing as npt

from trms_cli.controllers.fallback import Policy
from trms_cli.controllers.newton.problem import NewtonProblem
from trms_cli.controllers.reference_forecast import smooth_rates
from trms_cli.core.c_source import (
    GeneratedFunctions,
    SettingField,
    generate_source,
    number,
    text,
    whole_table,
    with_prefix,
)
from trms_cli.core.errors import ConfigurationError
from trms_cli.models.discretisation import DiscreteModel
from trms_cli.models.model import names

#: Predicted states that a program can hold on their soft limits; more are left to the accuracy of
#: its interior point.
_MOST_ON = 12
#: Inputs that stand at a bound and at the limit of their rate at once.
_MOST_FAST = 8
#: Changes of the active set before the interior point; soft limits come a few at a time.
_ROUNDS, _ROUNDS_WITH_LIMITS = 8, 24
#: Of the interior point; of each trial of the sides that it leads to (from a gap of 1e-2 to one of
#: 1e-12 there are seven, at shares of 0.03); of one change each after it.
_INTERIOR_ROUNDS, _TRIAL_ROUNDS, _MOST_TRIALS, _LAST_ROUNDS = 60, 4, 7, 40
#: Characters of generated C that a compiler takes in a minute or two.
_MOST_CODE = 8_000_000
_FOLDER = Path(__file__).parent
#: Templates of the source, in their order.
PARTS = ("steady_state.c", "horizon.c", "linear.c", "region.c", "riccati.c", "newton_mpc.c")


#: The size that says whether one of them is wanted.
_OPTIONAL = {"region.c": "REGION", "linear.c": "LINEAR"}


@dataclass(frozen=True)
class Companion:
    """C that goes along with a controller in one source: an observer's."""

    functions: Mapping[str, ca.Function]  #: What is generated for it, by name
    sizes: Mapping[str, tuple[int, str]]  #: Macros without prefix: value and comment
    tables: str  #: Its constants
    period: float  #: s, between two samples
    declarations: str  #: For the header; the line MPC_DEFINITIONS stands for its sizes
    code: str


def sizes_of(problem: NewtonProblem, preview: int) -> dict[str, tuple[int, str]]:
    """Sizes by macro (without prefix), each with what it counts."""
    model, horizon = problem.model, problem.horizon
    rates = np.isfinite(problem.largest_moves)
    terminal = model.n_x if horizon.terminal is not None else 0
    n_z, n_v = horizon.n_z, problem.discrete.n_x + model.n_u
    soft = len(horizon.limited) * horizon.n_periods
    n_on = min(soft, _MOST_ON) + (_MOST_FAST if rates.any() else 0)
    n_m = _filled(n_v + 1 + terminal + n_on)
    steady = len(problem.steady_state.unknowns)
    rounds = _ROUNDS_WITH_LIMITS if soft else _ROUNDS
    return {
        "N_X": (model.n_x, "states: " + _units(model.states)),
        "N_U": (model.n_u, "inputs: " + _units(model.inputs)),
        "N_W": (model.n_w, "torques: " + _units(model.disturbances)),
        "N_R": (len(model.controlled), "controlled: " + ", ".join(model.controlled)),
        "N_P": (len(model.parameters), "parameters of the model"),
        "N": (horizon.n_periods, "control periods ahead"),
        "PREVIEW": (preview, "control periods that the reference is known ahead"),
        "FORECAST": (
            problem.config.forecast_periods,
            "periods that an unknown reference is carried on for",
        ),
        "N_FULL": (problem.discrete.n_x, "states, and what is remembered of past commands"),
        "N_S": (steady, "unknowns of a steady state"),
        "REACHING": (
            int(problem.steady_state.reaching is not None),
            "whether angles at the reference settle a steady state",
        ),
        "N_PATHS": (len(model.path_memory), "states that remember a path and rest at any value"),
        "N_BLOCKS": (horizon.n_blocks, "blocks of constant inputs"),
        "N_Z": (n_z, "unknowns: N_U inputs in each block"),
        "N_WEIGHTED": (len(horizon.weighted), "states with a weight"),
        "N_DAMPED": (len(horizon.damped), "angles with a weight on their rate"),
        "N_LIMITED": (len(horizon.limited), "states with soft limits"),
        "N_TERMINAL": (terminal, "states that end in the steady state"),
        "REGION": (int(horizon.has_region), "whether the horizon ends in a region"),
        "LINEAR": (int(horizon.is_linear), "whether it is predicted by a linear model"),
        "RATES_LIMITED": (int(rates.any()), "whether an input's rate is limited"),
        "ROWS_SOFT": (soft, "soft limits over the horizon"),
        "N_V": (n_v, "states and inputs: what a value function is of"),
        "N_F": (_filled(n_v), "the same, filled up to a multiple of 4"),
        "N_ON": (n_on, "soft limits and rates that may be met exactly at once"),
        "N_PRICES": (terminal + n_on, "multipliers"),
        "N_M": (n_m, "states, inputs, 1 and multipliers, filled up in the same way"),
        "N_ROW": (n_m + model.n_u, "what an input's slope is of"),
        "ROUNDS": (rounds, "changes of the active set before the interior point"),
        "INTERIOR_ROUNDS": (_INTERIOR_ROUNDS, "of the interior point"),
        "TRIAL_ROUNDS": (_TRIAL_ROUNDS, "each time that the sides it leads to are tried"),
        "LAST_ROUNDS": (_LAST_ROUNDS, "changes of one side each, after it"),
        "RECURSIONS": (
            rounds + _INTERIOR_ROUNDS + _MOST_TRIALS * _TRIAL_ROUNDS + _LAST_ROUNDS,
            "over the horizon for a quadratic program, at the most",
        ),
        "QP_PAIRS": (
            2 * n_z * (1 + int(rates.any())) + 4 * soft,
            "bounds and limits of the quadratic program",
        ),
    }


def tables(problem: NewtonProblem) -> str:
    """Constants that no setting may change: what belongs to what."""
    model, horizon, steady = problem.model, problem.horizon, problem.steady_state
    limits = problem.config.soft_limits
    sources = [
        model.controlled.index(name) if name in model.controlled else -1
        for name in horizon.weighted
    ]
    goals = [horizon.limited.index(name) if name in limits else -1 for name in model.controlled]
    rows: dict[str, Iterable[int]] = {
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
        "mpc_memory_row": model.path_memory,
        "mpc_memory_unknown": [steady.unknowns.index(row) for row in model.path_memory],
    }
    whole = [whole_table(name, values) for name, values in rows.items()]
    rates = np.isfinite(problem.largest_moves)
    if rates.any():
        whole.append(whole_table("mpc_rate_limited", rates.astype(int)))
    return "\n".join(whole)


def settings(problem: NewtonProblem) -> list[SettingField]:
    """What may be changed between two steps, with its values in the problem."""
    model, horizon, config = problem.model, problem.horizon, problem.config
    at, parameters = horizon.arguments, model.parameters.values
    lower, upper = model.input_bounds()
    moves = np.where(np.isfinite(problem.largest_moves), problem.largest_moves, 0.0)
    inputs, n = names(model.inputs), len(horizon.weighted)
    tracked, rest = ", ".join(model.controlled), model.rest()
    stops = [model.stops.get(name, np.inf) for name in model.controlled]
    prices = at["prices"]

    def vector(name: str, size: str, values: npt.ArrayLike, comment: str) -> SettingField:
        return SettingField(name, f"[{size}]", np.asarray(values, dtype=np.float64), comment)

    def single(name: str, value: float, comment: str) -> SettingField:
        return SettingField(name, "", np.array([value], dtype=np.float64), comment)

    def whole(name: str, value: int, comment: str) -> SettingField:
        return SettingField(name, "", np.array([value]), comment, is_whole=True)

    return [
        vector("p", "MPC_ROOM(MPC_N_P)", parameters, "parameters, see the source for their names"),
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
            "soft_limits",
            "[MPC_ROOM(MPC_N_LIMITED)][2]",
            at["limits"].ravel(),
            "lower and upper, states' units, of " + (", ".join(horizon.limited) or "none"),
            least=2,
        ),
        single("soft_linear", prices[2], "price of violating them, 1/unit"),
        single("soft_quadratic", prices[3], "1/unit^2"),
        single("terminal_linear", prices[0], "price of missing the steady state"),
        single("terminal_quadratic", prices[1] or 1.0, "the same, of the square"),
        single("terminal_weight", config.terminal_weight, "of all states in a region's law"),
        single("terminal_decay", config.terminal_decay, "of the law that its cost keeps back"),
        vector("scale", "MPC_N_X", at["scale"], "typical sizes of the states, in their units"),
        vector("lower", "MPC_N_U", lower, "V, limits of the inputs"),
        vector("upper", "MPC_N_U", upper, "V; steady states take them for -lower"),
        vector("largest_moves", "MPC_N_U", moves, "V in a control period, where rates are limited"),
        vector(
            "steady_weights", "MPC_N_R", problem.steady_state.weights, f"of {tracked} out of reach"
        ),
        vector("stops", "MPC_N_R", stops, f"rad, mechanical ranges of {tracked}, +-"),
        vector(
            "steady_rest",
            "MPC_N_S",
            rest[list(problem.steady_state.unknowns)],
            "where searches for a steady state begin",
        ),
        vector(
            "full_rest",
            "MPC_N_FULL",
            problem.discrete.initial(rest, np.zeros(model.n_u)),
            "the rig at rest, with what is remembered of past commands",
        ),
        *problem.further_settings,
        single("tolerance", config.tolerance, "V, converged when no input moves more"),
        whole("max_iterations", config.max_iterations, "Newton iterations of a start"),
        whole(
            "compensation",
            config.disturbance_compensation,
            "whether w_hat enters prediction and steady state",
        ),
        whole(
            "fallback",
            1 + get_args(Policy).index(config.fallback),
            "what acts without a solution, of mpc_fallback",
        ),
        *problem.further_switches,
    ]


def parameter_comments(problem: NewtonProblem) -> str:
    """The parameters by position: name, value, unit, description."""
    lines = [
        f" *   p[{i:2d}] {p.name} = {p.value:g} {p.unit}"
        + (f": {p.description}" if p.description else "")
        for i, p in enumerate(problem.model.parameters)
    ]
    return "/* Parameters of the model:\n" + "\n".join(map(text, lines)) + "\n */"


def _units(signals: Any) -> str:
    return ", ".join(text(f"{signal.name} [{signal.unit}]") for signal in signals)


@dataclass(frozen=True)
class ControllerSource:
    """A controller in C."""

    controller: str  #: Its name
    header: str
    source: str
    sizes: dict[str, int]  #: The header's sizes, without their prefix
    period: float  #: s


def functions_of(problem: NewtonProblem) -> dict[str, ca.Function]:
    """What is generated of a problem, by its names in C."""
    functions = {
        "mpc_model_step": problem.discrete.step,
        "mpc_model_slopes": _slopes_by_row(problem.discrete),
        "mpc_steady_state_step": problem.steady_state.function,
    }
    if problem.steady_state.reaching is not None:
        functions["mpc_reaching_step"] = problem.steady_state.reaching
    if not problem.horizon.is_linear:
        functions["mpc_reference_rates"] = _reference_rates(problem)
    return functions


def newton_source(
    problem: NewtonProblem,
    preview: int,
    name: str,
    title: str,
    companion: Companion | None = None,
    *,
    with_values: bool = True,
) -> ControllerSource:
    """C of a Newton MPC.

    ``preview``: control periods that the reference is known ahead. ``name``: prefix of all names:
    ``NAME_step``. ``title``: first line of both files. ``with_values``: whether the problem's
    settings are inside. Raises ConfigurationError for a model whose C is too large to compile.
    """
    functions = functions_of(problem)
    own = tuple(functions)
    if companion is not None:
        functions |= companion.functions
    code = generate_source(functions)
    _check_size(code, problem.model.name)
    sizes = sizes_of(problem, preview) | _scratch(code, own, "")
    more: dict[str, tuple[int, str]] = {}
    if companion is not None:
        more = {**companion.sizes, **_scratch(code, companion.functions, "OBSERVER_")}
    fields, period = settings(problem), problem.discrete.step_length
    values = [f"    {field.value}" for field in fields] if with_values else ["    {0}"]
    source = "\n".join(
        [
            f"/* {title} */\n",
            '#include "mpc.h"\n\n#include <float.h>\n#include <math.h>\n#include <string.h>\n',
            *_room(code),
            *([parameter_comments(problem)] if with_values else []),
            "static const mpc_settings mpc_exported_settings = {\n" + ",\n".join(values) + "};\n",
            tables(problem),
            *([companion.tables] if companion is not None else []),
            "",
            code.source,
            *(template(part) for part in PARTS if sizes.get(_OPTIONAL.get(part, ""), (1,))[0]),
            *([companion.code] if companion is not None else []),
        ]
    )
    header = _header(sizes, fields, period, title, companion, more)
    return ControllerSource(
        problem.name,
        with_prefix(header, name),
        with_prefix(source, name),
        {key: value for key, (value, _) in (sizes | more).items()},
        period,
    )


def template(file: str) -> str:
    """The text of a file of this folder."""
    return (_FOLDER / file).read_text(encoding="utf-8")


def _header(
    sizes: Mapping[str, tuple[int, str]],
    fields: Sequence[SettingField],
    period: float,
    title: str,
    companion: Companion | None,
    more: Mapping[str, tuple[int, str]],
) -> str:
    declarations = ""
    if companion is not None:
        definitions = _definitions(more, "OBSERVER_PERIOD", companion.period)
        declarations = companion.declarations.replace("MPC_DEFINITIONS\n", definitions)
    parts = {
        "MPC_TITLE": title,
        "MPC_DEFINITIONS\n": _definitions(sizes, "PERIOD", period),
        "MPC_SETTINGS_FIELDS": "\n".join(
            f"    {field.declaration}; /* {text(field.comment)} */" for field in fields
        ),
        "MPC_OBSERVER_DECLARATIONS\n": declarations,
    }
    header = template("newton_mpc.h")
    for token, part in parts.items():
        header = header.replace(token, part)
    return header


def _definitions(sizes: Mapping[str, tuple[int, str]], name: str, period: float) -> str:
    lines = [
        f"#define MPC_{key} {value} /* {comment} */" for key, (value, comment) in sizes.items()
    ]
    lines.append(f"#define MPC_{name} {number(period)} /* s, from call to call */\n")
    return "\n".join(lines)


def _scratch(
    code: GeneratedFunctions, names: Iterable[str], prefix: str
) -> dict[str, tuple[int, str]]:
    selection = [code.functions[name] for name in names]
    return {
        f"{prefix}SZ_W": (max(f.sz_w() for f in selection), "numbers of scratch"),
        f"{prefix}SZ_IW": (max(f.sz_iw() for f in selection), "whole ones"),
    }


def _room(code: GeneratedFunctions) -> list[str]:
    """Room for the lists of arguments and results of each generated function."""
    short = {
        "model_step": "STEP",
        "model_slopes": "SLOPES",
        "steady_state_step": "STEADY",
        "reference_rates": "RATES",
    }
    lines = []
    for name, function in code.functions.items():
        word = name.removeprefix("mpc_")
        word = short.get(word, word.removesuffix("_step").upper())
        lines.append(f"#define MPC_{word}_ARG {function.sz_arg()}")
        lines.append(f"#define MPC_{word}_RES {function.sz_res()}")
    return lines


def _slopes_by_row(discrete: DiscreteModel) -> ca.Function:
    """``(x, u, p, w)`` → x⁺ and its slopes in (x, u), row after row, filled up as in C."""
    slopes = discrete.slopes("by_column")
    symbol = ca.SX.sym if slopes.is_a("SXFunction") else ca.MX.sym
    at = [symbol(name, slopes.size1_in(i)) for i, name in enumerate("xupw")]
    after, in_x, in_u = slopes(*at)
    n_v = discrete.n_x + discrete.model.n_u
    filling = ca.DM.zeros(_filled(n_v) - n_v, discrete.n_x)
    by_row = ca.densify(ca.vertcat(in_x.T, in_u.T, filling))
    return ca.Function("slopes", at, [after, by_row])


def _filled(count: int) -> int:
    """The next multiple of 4."""
    return -(-count // 4) * 4


def _reference_rates(problem: NewtonProblem) -> ca.Function:
    """References over the horizon → the rates that are wanted of the angles, (n_r, N) each."""
    shape = (len(problem.model.controlled), problem.horizon.n_periods)
    r = ca.SX.sym("r", *shape)
    return ca.Function("reference_rates", [r], [smooth_rates(r, problem.discrete.step_length)])


def _check_size(code: GeneratedFunctions, model: str) -> None:
    if len(code.source) > _MOST_CODE:
        raise ConfigurationError(
            f"model {model!r} makes {len(code.source) / 1e6:.0f} MB of C, too much for "
            "a rig's computer",
            where="model",
            remedy="export with a model of equations, or a smaller network",
        )
