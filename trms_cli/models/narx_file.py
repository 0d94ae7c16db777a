"""Network files: a trained NARX model as YAML, which ``model=PATH`` takes as any model file.

::

    name: narx_2dof
    model: narx
    source: trained on …                  # a line on how, and on what
    rig: newtonian                        # optional: option of configs/model that a run simulates
    limits: {u_v: 2.5, u_h: 2.5, alpha_v: 1.05, alpha_h: 2.8}
    structure: {outputs: [alpha_v, …], output_lags: [1, 2], sample_time: 0.02, …}
    network: {kind: mlp, regressor_mean: […], …, weights: {W1: [[…]], …}}
    training: {…}                         # optional: a record of the training, of any form
    effects: {…}                          # optional, as in every model file

Networks that travel with the program are in ``configs/networks`` and go by their name.

The network is a model of a rig in the place of equations: with the output y, the command u and
their samples of before (k counts the model's own samples)::

    ŷ(k+1) = N(y(k), …, y(k − l), u(k), …, u(k − m))           or y(k) + N(…), incremental

    y_j(k+1) = ŷ_j(k+1) + T² w_j       for an angle
    y_j(k+1) = ŷ_j(k+1) + T w_j        for a speed

The state is y(k) under the outputs' own names, then the outputs and inputs that are remembered
(``alpha_v_lag1`` is alpha_v one sample ago). The disturbances w are accelerations: a constant one
moves the output of a network of second order as a constant torque moves the rig, whatever the
sample time.

The weights are constants of the model and no parameters: there is no prior on them and no meaning
to one of them.

Source: S. Chen, S. A. Billings & P. M. Grant 1990, "Non-linear system identification using neural
networks", Int. J. Control 51(6).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np

from trms_cli.core.errors import ModelError
from trms_cli.models.black_box import (
    ANGLE,
    BlackBox,
    BlackBoxFile,
    check_file,
    common_entries,
    complaints_by_file,
    mapping_of,
    remembered_signals,
)
from trms_cli.models.model import FloatArray, Model, Signal
from trms_cli.models.network import NarxStructure, Network
from trms_cli.models.parameters import read_named
from trms_cli.models.rest import rest_equations

#: Value of ``model`` in a network file.
KIND = "narx"
#: Newton steps to the rest, and the seconds of free run before them.
_ITERATIONS, _SETTLING = 50, 60.0
_AT_REST = 1e-10


class Narx(BlackBox):
    """A network that predicts the next outputs from past outputs and commands.

    Raises ModelError if network and structure do not fit, or a limit names no input or angle.

    ``structure``: what the regressor is made of. ``network``: of as many regressors and outputs as
    the structure has. ``limits``: as :class:`trms_cli.models.black_box.BlackBox` takes them.
    """

    def __init__(
        self,
        structure: NarxStructure,
        network: Network,
        *,
        name: str = "narx",
        limits: Mapping[str, float] | None = None,
    ) -> None:
        _check_fit(structure, network)
        self.structure, self.network = structure, network
        outputs = tuple(map(Signal, structure.outputs, structure.output_units))
        inputs = tuple(map(Signal, structure.inputs, structure.input_units))
        memory = [
            *remembered_signals(outputs, structure.output_lags[-1] - 1),
            *remembered_signals(inputs, structure.input_lags[-1] - 1),
        ]
        super().__init__(outputs, inputs, memory, structure.sample_time, name=name, limits=limits)
        self._rest: FloatArray | None = None

    def transition(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        n_y, n_u = self.n_y, self.n_u
        kept_y = n_y * (self.structure.output_lags[-1] - 1)
        # y(k), y(k − 1), … and u(k), u(k − 1), …: newest first, all signals of a sample together
        outputs = x[: n_y + kept_y, 0]
        inputs = ca.vertcat(u, x[n_y + kept_y :, 0])
        lagged = ca.vertcat(
            *(outputs[n_y * (lag - 1) : n_y * lag, 0] for lag in self.structure.output_lags),
            *(inputs[n_u * (lag - 1) : n_u * lag, 0] for lag in self.structure.input_lags),
        )
        following = self.network.expression(ca.DM(self.structure.arrangement()) @ lagged)
        if self.structure.incremental:
            following += outputs[:n_y, 0]
        following += ca.DM(self._push_scale()) * w
        return ca.vertcat(following, outputs[:kept_y, 0], inputs[: inputs.shape[0] - n_u, 0])

    def rest(self) -> FloatArray:
        """Where the network settles without a command, as nearly as it does."""
        if self._rest is None:
            self._rest = _settled(self)
        return self._rest.copy()

    def _push_scale(self) -> FloatArray:
        """Change of each output in a step by a unit of its disturbance."""
        T = self.structure.sample_time
        return np.array([T**2 if y.unit == ANGLE else T for y in self.outputs])


def _check_fit(structure: NarxStructure, network: Network) -> None:
    for key, size, expected in (
        ("regressor_mean", network.n_regressors, structure.n_regressors),
        ("output_mean", network.n_outputs, len(structure.outputs)),
    ):
        if size != expected:
            raise ModelError(
                f"the network has {size} and the structure {expected}",
                where=f"network.{key}",
                remedy="structure and network belong together: take both from one training",
            )


def _settled(model: Narx) -> FloatArray:
    """A fixed point without a command: a free run, then Newton's method from where it ended.

    The run goes to a fixed point that is stable, where the network has several; an end that
    Newton's method does not improve is kept as it is.
    """
    equations = rest_equations(model)
    _, u, p, w = model.symbols()
    s = ca.SX.sym("s", len(equations.unknowns))
    residual = equations.residual(s, u, p, w)
    newton = ca.Function("newton", [s, u, p, w], [residual, ca.jacobian(residual, s)])
    lifted = ca.Function("lifted", [s, u], [equations.state(s, u)])
    still = (np.zeros(model.n_u), model.parameters.values, np.zeros(model.n_w))

    rows = list(equations.unknowns)
    n_y = model.n_y
    start = np.zeros(model.n_x)
    start[:n_y] = model.network.regressor_mean[:n_y]
    at = model.symbols()
    step = ca.Function("free", list(at), [model.transition(*at)])
    count = max(1, round(_SETTLING / model.sample_time))
    arguments = (ca.repmat(ca.DM(value), 1, count) for value in still)
    ends = np.array(step.mapaccum(count)(lifted(start[rows], still[0]), *arguments))[:, -1]
    point = ends[rows] if np.isfinite(ends).all() else start[rows]
    fixed = _newton(newton, point, still)
    return np.array(lifted(fixed, still[0]))[:, 0]


def _newton(
    function: ca.Function, start: FloatArray, constant: tuple[FloatArray, ...]
) -> FloatArray:
    point = start.copy()
    for _ in range(_ITERATIONS):
        rate, slope = (np.array(value) for value in function(point, *constant))
        move, *_ = np.linalg.lstsq(slope, -rate[:, 0], rcond=1e-10)
        point = point + move
        if not np.isfinite(point).all():
            return start
        if np.abs(move).max() < _AT_REST * (1.0 + np.abs(point).max()):
            return point
    return start


@dataclass(frozen=True, kw_only=True, eq=False)
class NarxFile(BlackBoxFile):
    """The content of a network file."""

    kind = KIND
    body = ("structure", "network")

    structure: NarxStructure
    network: Network

    def model(self) -> Narx:
        """The model.

        Raises ModelError if structure, network and limits do not fit together.
        """
        return Narx(self.structure, self.network, name=KIND, limits=self.limits)


def narx(*, network: str, rig: Model | None = None) -> Narx:
    """The NARX model of a network.

    Raises ConfigurationError if there is no such network. Raises ModelError for a file that does
    not hold one; it names the file and the key.

    ``network``: A network that travels with the program, by name, or the path of a network file.
    ``rig``: the rig that it was trained on. A run simulates it in the place of the network; to the
    model itself it means nothing.
    """
    content = read_narx_file(network, where="model.network")
    return narx_of(content, network)


def narx_of(content: NarxFile, path: str) -> Narx:
    """The model of a network file, with complaints by the file's keys."""
    with complaints_by_file(path):
        return content.model()


def read_narx_file(name_or_path: str, where: str = "model.path") -> NarxFile:
    """Read a network: one that travels with the program by name, or a file by path.

    Raises ConfigurationError if there is none. Raises ModelError if the content is not of the
    documented form; it names the file and the key.
    """
    path, text = read_named(name_or_path, where, "networks", "network", "network file")
    data = mapping_of(path, text, "compare it with configs/networks/narx_2dof.yaml")
    label = name_or_path
    check_file(data, label, NarxFile, "network")
    return NarxFile(
        structure=NarxStructure.from_data(data["structure"], f"{label}: structure"),
        network=Network.from_data(data["network"], f"{label}: network"),
        **common_entries(data, label),
    )


def write_narx_file(path: Path, content: NarxFile) -> None:
    """Write a network file; read back, every weight has its bits."""
    import yaml

    text = yaml.dump(
        content.to_data(),
        Dumper=getattr(yaml, "CSafeDumper", yaml.SafeDumper),
        sort_keys=False,
        allow_unicode=True,
        default_flow_style=None,
        width=100,
    )
    path.write_text(text, encoding="utf-8")
