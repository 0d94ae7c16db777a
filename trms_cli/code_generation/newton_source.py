"""The C source and header of a Newton MPC: templates, tables and generated functions in one."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca

from trms_cli.code_generation import newton_tables
from trms_cli.code_generation.casadi_source import GeneratedFunctions, generated
from trms_cli.code_generation.literals import number
from trms_cli.code_generation.observer_source import ObserverSource
from trms_cli.controllers.controller import ControlSetup
from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.controllers.reference_forecast import smooth_rates
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.qp import Daqp

_TEMPLATES = Path(__file__).parent
_FALLBACKS = {"shifted_plan": "SHIFTED_PLAN", "hold": "HOLD", "steady_input": "STEADY_INPUT"}
#: Lines of generated C that a compiler takes in a minute or two.
_MOST_CODE = 8_000_000


@dataclass(frozen=True)
class ControllerSource:
    """A controller in C."""

    header: str
    source: str
    sizes: dict[str, int]  #: The header's sizes, without their prefix
    period: float  #: s


def newton_source(
    controller: NewtonMpc,
    setup: ControlSetup,
    name: str,
    title: str,
    observer: ObserverSource | None = None,
) -> ControllerSource:
    """C of a Newton MPC.

    Parameters
    ----------
    controller : NewtonMpc
    setup : ControlSetup
        The model that it believes and its period.
    name : str
        Prefix of all names: ``NAME_step``.
    title : str
        First line of both files.
    observer : ObserverSource, optional
        A filter to go with it.

    Raises
    ------
    ConfigurationError
        For what has no C: it names the key.
    """
    check_exportable(controller)
    state = controller.init(setup)
    functions = {
        "mpc_model_step": state.discrete.step,
        "mpc_model_slopes": state.discrete.slopes(),
        "mpc_steady_state_step": state.steady_state.function,
        "mpc_reference_rates": _reference_rates(state),
    }
    own = tuple(functions)
    if observer is not None:
        functions |= observer.functions
    code = generated(functions)
    _check_size(code, setup)
    sizes = newton_tables.sizes(state, controller.preview(setup)) | _scratch(code, own, "")
    filter_sizes: dict[str, tuple[int, str]] = {}
    if observer is not None:
        filter_sizes = {**observer.sizes, **_scratch(code, observer.functions, "OBSERVER_")}
    period = setup.sample_time
    header = _header(sizes, state, period, title, observer, filter_sizes)
    parts = ["daqp.c", "steady_state.c", "horizon.c", "newton_mpc.c"]
    source = "\n".join(
        [
            f"/* {title} */\n",
            '#include "mpc.h"\n\n#include <float.h>\n#include <math.h>\n#include <string.h>\n',
            *_room(code),
            f"#define MPC_COMPENSATION {int(controller.disturbance_compensation)}",
            f"#define MPC_FALLBACK MPC_{_FALLBACKS[controller.fallback]}\n",
            newton_tables.parameter_comments(state),
            _initialiser(state),
            newton_tables.tables(state),
            *([observer.tables] if observer is not None else []),
            "",
            code.source,
            *map(_template, [*parts, *(["observer.c"] if observer is not None else [])]),
        ]
    )
    return ControllerSource(
        named(header, name),
        named(source, name),
        {key: value for key, (value, _) in (sizes | filter_sizes).items()},
        period,
    )


def check_exportable(controller: Any) -> None:
    """Raise :class:`ConfigurationError` for a controller, or an option of it, that has no C."""
    if not isinstance(controller, NewtonMpc):
        raise ConfigurationError(
            f"{type(controller).__name__} has no C source",
            where="controller",
            remedy="export newton_mpc: controller=newton_mpc",
        )
    if controller.terminal not in ("equality", "none"):
        raise ConfigurationError(
            f"terminal {controller.terminal!r} has no C source",
            where="controller.terminal",
            remedy="take equality or none",
        )
    if controller.fallback not in _FALLBACKS:
        raise ConfigurationError(
            f"fallback {controller.fallback!r} has no C source: a rig's computer cannot end a run",
            where="controller.fallback",
            remedy=f"take one of {', '.join(_FALLBACKS)}",
        )
    if type(controller.qp) is not Daqp:
        raise ConfigurationError(
            f"the QP solver {type(controller.qp).__name__} has no C source",
            where="controller.qp",
            remedy="take daqp: qp_solver@controller.qp=daqp",
        )


def named(text: str, name: str) -> str:
    """A template's text with a controller's own name in place of ``mpc``."""
    text = re.sub(r"\bMPC_(?=\w)", f"{name.upper()}_", text)
    text = re.sub(r"\bmpc_(?=\w)", f"{name}_", text)
    return text.replace('"mpc.h"', f'"{name}.h"')


def _template(file: str) -> str:
    return (_TEMPLATES / file).read_text(encoding="utf-8")


def _header(
    sizes: Mapping[str, tuple[int, str]],
    state: Any,
    period: float,
    title: str,
    observer: ObserverSource | None,
    filter_sizes: Mapping[str, tuple[int, str]],
) -> str:
    fields = "\n".join(
        f"    {setting.declaration}; /* {setting.comment} */"
        for setting in newton_tables.settings(state)
    )
    declarations = ""
    if observer is not None:
        definitions = _definitions(filter_sizes, "OBSERVER_PERIOD", observer.period)
        declarations = _template("observer.h").replace("MPC_DEFINITIONS\n", definitions)
    parts = {
        "MPC_TITLE": title,
        "MPC_DEFINITIONS\n": _definitions(sizes, "PERIOD", period),
        "MPC_SETTINGS_FIELDS": fields,
        "MPC_OBSERVER_DECLARATIONS\n": declarations,
    }
    text = _template("newton_mpc.h")
    for token, part in parts.items():
        text = text.replace(token, part)
    return text


def _definitions(sizes: Mapping[str, tuple[int, str]], name: str, period: float) -> str:
    lines = [
        f"#define MPC_{key} {value} /* {comment} */" for key, (value, comment) in sizes.items()
    ]
    lines.append(f"#define MPC_{name} {number(period)} /* s, from call to call */\n")
    return "\n".join(lines)


def _scratch(
    code: GeneratedFunctions, names: Iterable[str], prefix: str
) -> dict[str, tuple[int, str]]:
    chosen = list(names)
    return {
        f"{prefix}SZ_W": (max(code.n_w[n] for n in chosen), "numbers of scratch"),
        f"{prefix}SZ_IW": (max(code.n_iw[n] for n in chosen), "whole ones"),
    }


def _initialiser(state: Any) -> str:
    fields = ",\n".join(f"    {setting.value}" for setting in newton_tables.settings(state))
    return f"static const mpc_settings mpc_exported_settings = {{\n{fields}}};\n"


def _room(code: GeneratedFunctions) -> list[str]:
    """Room for the lists of arguments and results of each generated function."""
    short = {
        "model_step": "STEP",
        "model_slopes": "SLOPES",
        "steady_state_step": "STEADY",
        "reference_rates": "RATES",
    }
    lines = []
    for function in code.n_arg:
        word = function.removeprefix("mpc_")
        word = short.get(word, word.removesuffix("_step").upper())
        lines.append(f"#define MPC_{word}_ARG {code.n_arg[function]}")
        lines.append(f"#define MPC_{word}_RES {code.n_res[function]}")
    return lines


def _reference_rates(state: Any) -> ca.Function:
    """References over the horizon → the rates that are wanted of the angles, (n_r, N) each."""
    shape = (len(state.model.controlled), state.newton.horizon.n_periods)
    r = ca.SX.sym("r", *shape)
    return ca.Function("reference_rates", [r], [smooth_rates(r, state.discrete.step_length)])


def _check_size(code: GeneratedFunctions, setup: ControlSetup) -> None:
    if len(code.source) > _MOST_CODE:
        raise ConfigurationError(
            f"model {setup.model.name!r} makes {len(code.source) / 1e6:.0f} MB of C, too much for "
            "a rig's computer",
            where="model",
            remedy="export with a model of equations, or a smaller network",
        )
