"""A controller as a folder of C: source, header, example, Makefile, README.

The example holds samples of a closed loop under the Python controller, for the exported one to be
held against.
"""

import re
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from trms_cli import __version__
from trms_cli.code_generation.measure import ExampleMeasurement
from trms_cli.code_generation.observer_source import ObserverSource, observer_source, template
from trms_cli.controllers.controller import ControlSample, ControlSetup
from trms_cli.controllers.linear_mpc import LinearMpc
from trms_cli.controllers.newton.source import ControllerSource, newton_source
from trms_cli.controllers.newton.terminals import STATES
from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.controllers.qp.riccati import Riccati
from trms_cli.core.arrays import FloatArray
from trms_cli.core.c_source import with_prefix
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.qp import Daqp
from trms_cli.models.discretisation import discretise
from trms_cli.models.estimate import Estimate
from trms_cli.models.model import names
from trms_cli.observers.observer import ObserverSetup
from trms_cli.observers.recursive_filter import RecursiveFilter
from trms_cli.references.trajectory import ReferenceTrajectory
from trms_cli.simulation.preparation import reference_of

#: N m, of the torques that stand for a filter's: no two are equal, as in a real loop.
_TORQUE_SD = 1e-4
_LONGEST_SUBSTEP = 0.02  # s


def example_rows(
    controller: NewtonMpc, setup: ControlSetup, reference: ReferenceTrajectory, samples: int
) -> FloatArray:
    """A closed loop with the model itself as the rig.

    Returns (samples, n) array; estimate, torques, references, last command, and the command that
    was chosen.
    """
    model, period = setup.model, setup.sample_time
    preview = controller.preview(setup)
    times = np.arange(samples + preview, dtype=np.float64) * period
    references = reference_of(model, reference).sample(times)
    substeps = 1 if model.sample_time else max(1, int(np.ceil(period / _LONGEST_SUBSTEP)))
    discrete = discretise(model, period, substeps)
    step, p = BufferedFunction(discrete.step), model.parameters.values
    state = controller.init(setup)
    draw = np.random.default_rng(0)
    u, still = setup.first_command.copy(), np.zeros(model.n_w)
    full, rows = discrete.initial(model.rest(), u), []
    for k in range(samples):
        x = full[: model.n_x].copy()
        w = _TORQUE_SD * draw.standard_normal(model.n_w)
        window = references[k : k + preview + 1]
        sample = ControlSample(k * period, window, Estimate(x, 0 * x, w, 0 * w), u)
        u_next = controller.step(state, sample, want_prediction=False).u
        rows.append(np.concatenate([x, w, window.ravel(), u, u_next]))
        u = u_next
        full = step.evaluate(full, u, p, still)[0].copy()
    return np.array(rows)


def example_csv(rows: FloatArray, setup: ControlSetup, preview: int) -> str:
    """The rows with a heading; every number reads back to the same bits."""
    model = setup.model
    columns = [
        *model.state_names,
        *(f"w_{name}" for name in names(model.disturbances)),
        *(f"r_{name}[{k}]" for k in range(preview + 1) for name in model.controlled),
        *(f"previous_{name}" for name in names(model.inputs)),
        *names(model.inputs),
    ]
    lines = [",".join(map(repr, row)) for row in rows.tolist()]
    return "# " + ",".join(columns) + "\n" + "\n".join(lines) + "\n"


@dataclass(frozen=True)
class Export:
    """What is written."""

    name: str  #: Prefix of all names in C
    setup: ControlSetup
    controller: NewtonMpc | LinearMpc
    source: ControllerSource
    observer: ObserverSource | None
    #: Content by file name; the README comes last, by :meth:`readme`
    files: dict[str, str] = field(default_factory=dict)

    def readme(self, command: str, measured: ExampleMeasurement | None) -> str:
        """Markdown: what it is, how to call it, signals, memory, times if they were measured."""
        text = with_prefix(template("readme.md").replace("MPC_CALL", _call(self)), self.name)
        text = re.sub(r"\bmpc\b", self.name, text)
        for token, part in {
            "KIND": _kind(self.controller),
            "SIGNALS": _signals(self),
            "FIGURES": _figures(self, measured),
            "COMMAND": command,
        }.items():
            text = text.replace(f"{self.name.upper()}_{token}", part)
        return text

    def document(self, command: str, measured: ExampleMeasurement | None) -> dict[str, Any]:
        """The same figures for programs."""
        return {
            "schema": "trms.export-controller/1",
            "version": __version__,
            "command": command,
            "name": self.name,
            "model": self.setup.model.name,
            "control_period_s": self.source.period,
            "sizes": self.source.sizes,
            "signals": {
                "states": self.setup.model.state_names,
                "disturbances": names(self.setup.model.disturbances),
                "inputs": names(self.setup.model.inputs),
                "controlled": self.setup.model.controlled,
            },
            "observer": None
            if self.observer is None
            else {"channels": self.observer.channels, "sample_time_s": self.observer.period},
            "measured": None if measured is None else asdict(measured),
        }


def export(
    controller: Any,
    setup: ControlSetup,
    reference: ReferenceTrajectory,
    *,
    name: str,
    samples: int,
    observer: Any = None,
    observing: ObserverSetup | None = None,
) -> Export:
    """The files of a controller in C.

    ``controller``, ``observer``: as a closed loop has them; the observer goes along if it is a
    filter. ``reference``: followed in the samples that come with it. ``name``: a C identifier, in
    small letters. ``samples``: control periods in them. ``observing``: channels and noise that the
    observer is made for. Raises ConfigurationError for what has no C.
    """
    check_exportable(controller)
    part = None
    if isinstance(observer, RecursiveFilter) and observing is not None:
        part = observer_source(observer, observing)
    title = f"{_kind(controller)} of model {setup.model.name}, by trms {__version__}"
    preview = controller.preview(setup)
    source = newton_source(controller.problem(setup), preview, name, title, part)
    rows = example_rows(controller, setup, reference, samples)
    example = template("example.c")
    for token, words in {
        "MPC_OBSERVER_FUNCTION\n": "" if part is None else template("example_observer.c"),
        "MPC_OBSERVER_CALL\n": "" if part is None else "    time_observer();\n",
    }.items():
        example = example.replace(token, words)
    files = {
        f"{name}.c": source.source,
        f"{name}.h": source.header,
        f"{name}_example.c": with_prefix(example, name),
        "Makefile": with_prefix(template("example.mk"), name).replace("mpc.", f"{name}."),
        "example.csv": example_csv(rows, setup, preview),
    }
    return Export(name, setup, controller, source, part, files)


def check_exportable(controller: Any, option: str = "") -> None:
    """Raise :class:`ConfigurationError` for a controller, or an option of it, that has no C.

    ``option``: as it was chosen, for the message.
    """
    # A law derived from one of these that starts otherwise is another law, and not in the C.
    if getattr(type(controller), "init", None) not in (NewtonMpc.init, LinearMpc.init):
        raise ConfigurationError(
            f"{f'controller={option}' if option else 'this controller'} has no C source",
            where="controller",
            remedy="export newton_mpc or linear_mpc: controller=newton_mpc",
        )
    if controller.terminal in STATES:
        raise ConfigurationError(
            f"terminal={controller.terminal} has no C source: it runs in NumPy alone",
            where="controller.terminal",
            remedy="export terminal=equality, quasi_infinite or none",
        )
    if type(controller.qp) not in (Riccati, Daqp):
        raise ConfigurationError(
            "only the engine's own QP solver has C source",
            where="controller.qp",
            remedy="take riccati: qp_solver@controller.qp=riccati",
        )


def _kind(controller: NewtonMpc | LinearMpc) -> str:
    return "Newton MPC" if isinstance(controller, NewtonMpc) else "Linear MPC"


def _call(export: Export) -> str:
    """How the functions are called, with the observer where there is one."""
    if export.observer is None:
        return template("readme_call.md").replace("MPC_SECONDS", f"{export.source.period:g}")
    period = export.observer.period
    text = template("readme_observer.md").replace("MPC_SECONDS", f"{period:g}")
    return text.replace("MPC_RATIO", str(round(export.source.period / period)))


def _signals(export: Export) -> str:
    model, upper = export.setup.model, export.name.upper()
    preview = export.controller.preview(export.setup)
    lines = ["## Signals\n", "| argument | position | signal | unit |", "|---|---|---|---|"]
    groups = {
        "x_hat": model.states,
        "w_hat": model.disturbances,
        "u, u_previous": model.inputs,
    }
    if export.observer is not None:
        outputs = {s.name: s for s in model.outputs}
        groups["y"] = tuple(outputs[name] for name in export.observer.channels)
    for argument, signals in groups.items():
        for i, s in enumerate(signals):
            words = f"{s.name}: {s.description}" if s.description else s.name
            lines.append(f"| `{argument}` | {i} | {words} | {s.unit} |")
    followed = ", ".join(model.controlled)
    lower, upper_bound = model.input_bounds()
    limits = ", ".join(
        f"{s.name} {a:g} … {b:g} {s.unit}"
        for s, a, b in zip(model.inputs, lower.tolist(), upper_bound.tolist(), strict=True)
    )
    lines.append(
        f"\n`reference[k * {upper}_N_R + i]`: {followed} (i), k = 0 … {preview} control periods "
        f"ahead. Limits of the commands: {limits}.\n"
    )
    return "\n".join(lines)


def _figures(export: Export, measured: ExampleMeasurement | None) -> str:
    sizes = export.source.sizes
    what = (
        f"{sizes['N']} control periods, {sizes['N_Z']} unknowns"
        + (f", {sizes['ROWS_SOFT']} soft limits" if sizes["ROWS_SOFT"] else "")
        + f", at most {export.controller.max_iterations} iterations"
    )
    if measured is None:
        return (
            f"## Memory and time\n\n{what}. Not measured here: `make check` and `make size` do.\n\n"
            + _worst_case(export)
        )
    times = {
        "step, median": measured.median,
        "step, 99 %": measured.p99,
        "step, slowest sample in the best of five passes": measured.slowest,
        "step, longest of all": measured.longest,
        "observer, median": measured.observer_median,
        "observer, 99 %": measured.observer_p99,
        "observer, longest": measured.observer_longest,
    }
    room = {
        "context (`sizeof`)": measured.context_bytes,
        "observer (`sizeof`)": measured.observer_bytes or None,
        "code and constants": measured.code_bytes,
        "`.data` and `.bss`": measured.data_bytes,
        "stack, at the most (all frames together)": measured.stack_bytes,
    }
    rows = [(key, f"{value:.1f} µs") for key, value in times.items() if value is not None]
    difference = f"{measured.largest_difference:.2g} V"
    rows.append(("largest difference to the Python controller", difference))
    rows += [(key, _bytes(count)) for key, count in room.items() if count is not None]
    table = "\n".join(f"| {key} | {value} |" for key, value in rows)
    return f"""\
## Memory and time

{what}. {measured.samples} steps of `example.csv` on {measured.processor}, {measured.compiler},
`-std=c99 -O3`; the machine's other work is in
the longest times.

| | |
|---|---|
{table}

{_worst_case(export)}"""


def _worst_case(export: Export) -> str:
    """The most that a step can take."""
    s = export.source.sizes
    most = export.controller.max_iterations
    products = s["N_V"] * s["N_FULL"] * (s["N_F"] + s["N_M"])
    products += s["N_U"] * (s["N_V"] + 1 + s["N_PRICES"]) * s["N_M"]
    recursion = s["N"] * products
    return f"""\
A step makes at most {2 * most} Newton iterations ({most}, and as many from a second start where
the reference has changed and the plan sees no way to it). Each solves one quadratic program in at
most {s["RECURSIONS"]} recursions over the horizon, of about {recursion} multiplications and
additions; one is usual. Where they end before the solution, the interior point's last plan acts,
which keeps the limits of inputs and rates: `info.capped` is 1 and the status `BUDGET`. A line
search takes at most 6 predictions.
"""


def _bytes(count: int) -> str:
    return f"{count} bytes" if count < 10_000 else f"{count / 1024:.0f} KiB"
