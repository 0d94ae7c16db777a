"""The C of a recursive filter (UKF, EKF, …) that goes with a controller."""

from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np

from trms_cli.controllers.newton.source import Companion
from trms_cli.core.c_source import number, table, text, whole_table
from trms_cli.core.errors import ConfigurationError
from trms_cli.models.model import Model
from trms_cli.models.rest import equation_weights, rest_equations
from trms_cli.observers.augmentation import augment
from trms_cli.observers.observer import ObserverSetup
from trms_cli.observers.recursive_filter import INPUTS, RecursiveFilter

#: Keeps a least-squares solution short where the equations do not say.
_SHORT = 1e-7


@dataclass(frozen=True)
class ObserverSource(Companion):
    """A filter in C."""

    channels: tuple[str, ...]  #: Measured, in the order of ``y``
    states: tuple[str, ...]  #: Of its mean: states, then torques


def observer_source(observer: RecursiveFilter, setup: ObserverSetup) -> ObserverSource:
    """C of a filter.

    Raises ConfigurationError for sensors with memory.
    """
    augmented = augment(setup, observer)
    if augmented.discrete.n_sensors:
        raise ConfigurationError(
            f"an observer of model {setup.model.name!r}, whose sensors remember, has no C source",
            where="observer",
            remedy="export the controller alone: observer=full_state",
        )
    step, _ = observer.compose(setup, augmented)
    state = observer.init(setup)
    arguments = dict(zip(INPUTS, state.function.inputs, strict=True))
    model, gate = setup.model, state.gate
    functions = {"mpc_filter_step": step, "mpc_resting_step": resting_step(model, setup.outputs)}
    if augmented.n_m:
        functions["mpc_sample_step"] = augmented.discrete.step
    units = {signal.name: signal.unit for signal in model.outputs}
    channels = ", ".join(text(f"{name} [{units[name]}]") for name in setup.outputs)
    sizes = {
        "N_Y": (len(setup.outputs), f"measured: {channels}"),
        "N_Z_HAT": (augmented.n, "estimated: " + text(", ".join(augmented.names))),
        "N_MEMORY": (augmented.n_m, "what is remembered of past commands"),
        "N_P_HAT": (arguments["p"].size, "parameters of its step"),
    }
    rows = list(rest_equations(model).unknowns)
    measured = [
        rows.index(model.state_index(name))
        if name in model.state_names and model.state_index(name) in rows
        else -1
        for name in setup.outputs
    ]
    settled = state.settled
    width = gate.width
    constants = [
        f"#define MPC_GATE {number(width)}",
        f"#define MPC_PATIENCE {gate.patience}",
        f"#define MPC_STEADY_GAIN {int(settled is not None)}",
        table("mpc_filter_p", arguments["p"]),
        table("mpc_filter_q", augmented.q),
        table("mpc_filter_r", augmented.r),
        table("mpc_filter_floor", augmented.floor),
        table("mpc_filter_sd", augmented.sd),
        table(
            "mpc_filter_settled",
            np.zeros((augmented.n, augmented.n)) if settled is None else settled.ravel(order="F"),
        ),
        table("mpc_resting_p", model.parameters.values),
        whole_table("mpc_filter_measured", measured),
    ]
    return ObserverSource(
        functions,
        sizes,
        "\n".join(constants),
        setup.sample_time,
        template("observer.h"),
        template("observer.c"),
        setup.outputs,
        augmented.names,
    )


def template(file: str) -> str:
    """The text of a file of this folder that C or a README is made of."""
    return (Path(__file__).parent / file).read_text(encoding="utf-8")


def resting_step(model: Model, outputs: tuple[str, ...]) -> ca.Function:
    """One Gauss–Newton step of :func:`trms_cli.models.rest.resting_state`.

    ``(s, u, p) → next s, largest move (as a share of its scale), whole state at s`` with the
    measured channels among s known and the others solved for.
    """
    equations = rest_equations(model)
    rows = list(equations.unknowns)
    measured_names = {name for name in outputs if name in model.state_names}
    unknown = [k for k, i in enumerate(rows) if model.state_names[i] not in measured_names]
    _, u, p, w = model.symbols()
    s = ca.SX.sym("s", len(rows))
    after, largest = ca.SX(s), ca.SX(0)
    if unknown:
        weights = ca.DM(equation_weights(model, rows, measured_names))
        f = weights * ca.substitute(equations.residual(s, u, p, w), w, ca.SX.zeros(model.n_w))
        slope = ca.densify(ca.jacobian(f, s)[:, unknown])
        scale = ca.fmax(ca.sqrt(ca.sum1(slope**2)).T, 1e-12)
        scaled = slope / ca.repmat(scale.T, len(rows), 1)
        system = ca.vertcat(scaled, _SHORT * ca.SX.eye(len(unknown)))
        q, r = ca.qr(ca.densify(system))
        move = -ca.solve(r, q.T @ ca.vertcat(f, ca.SX.zeros(len(unknown))))
        largest = ca.mmax(ca.fabs(move))
        for k, row in enumerate(unknown):
            after[row] = s[row] + move[k] / scale[k]
    return ca.Function("resting_step", [s, u, p], [after, largest, equations.state(s, u)])
