"""Network files: a trained NARX model as YAML, which ``model=PATH`` takes as any model file.

::

    name: narx_2dof
    model: narx
    source: trained on …                  # a line on how, and on what
    rig: newtonian                        # optional: option of configs/model that a run simulates
    limits: {u_v: 2.5, u_h: 2.5, alpha_v: 1.05, alpha_h: 2.8}
    structure: {outputs: [alpha_v, …], output_lags: [1, 2], sample_time: 0.02, …}
                                          # or of a state space, with order in the place of lags
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
sample time. A network with past residuals among its regressors runs with residuals of zero, for
nothing is measured in a free run.

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

from trms_cli.models.black_box import (
    BlackBox,
    BlackBoxFile,
    check_file,
    common_entries,
    complaints_by_file,
    mapping_of,
    remembered_signals,
)
from trms_cli.models.innovation_network import (
    InnovationNetwork,
    InnovationStructure,
    check_fit,
    push_scale,
    structure_from_data,
)
from trms_cli.models.model import FloatArray, Model, Signal
from trms_cli.models.network import NarxStructure, Network
from trms_cli.models.parameters import read_named
from trms_cli.models.rest import settled_state

#: Value of ``model`` in a network file.
KIND = "narx"


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
        check_fit(structure, network)
        self.structure, self.network = structure, network
        outputs = tuple(map(Signal, structure.outputs, structure.output_units))
        inputs = tuple(map(Signal, structure.inputs, structure.input_units))
        memory = [
            *remembered_signals(outputs, structure.longest_output_lag - 1),
            *remembered_signals(inputs, structure.input_lags[-1] - 1),
        ]
        super().__init__(outputs, inputs, memory, structure.sample_time, name=name, limits=limits)
        self._rest: FloatArray | None = None

    def transition(self, x: ca.SX, u: ca.SX, p: ca.SX, w: ca.SX) -> ca.SX:
        n_y, n_u = self.n_y, self.n_u
        kept_y = n_y * (self.structure.longest_output_lag - 1)
        # y(k), y(k − 1), … and u(k), u(k − 1), …: newest first, all signals of a sample together
        outputs = x[: n_y + kept_y, 0]
        inputs = ca.vertcat(u, x[n_y + kept_y :, 0])
        lagged = ca.vertcat(
            *(outputs[n_y * (lag - 1) : n_y * lag, 0] for lag in self.structure.output_lags),
            *(inputs[n_u * (lag - 1) : n_u * lag, 0] for lag in self.structure.input_lags),
            ca.DM.zeros(self.structure.n_residuals, 1),
        )
        following = self.network.expression(ca.DM(self.structure.arrangement()) @ lagged)
        if self.structure.incremental:
            following += outputs[:n_y, 0]
        following += ca.DM(push_scale(self.outputs, self.structure.sample_time)) * w
        return ca.vertcat(following, outputs[:kept_y, 0], inputs[: inputs.shape[0] - n_u, 0])

    def rest(self) -> FloatArray:
        """Where the network settles without a command, as nearly as it does."""
        if self._rest is None:
            start = np.zeros(self.n_x)
            if self.structure.output_lags:
                start[: self.n_y] = self.network.regressor_mean[: self.n_y]
            self._rest = settled_state(self, start)
        return self._rest.copy()


@dataclass(frozen=True, kw_only=True, eq=False)
class NarxFile(BlackBoxFile):
    """The content of a network file."""

    kind = KIND
    body = ("structure", "network")

    structure: NarxStructure | InnovationStructure
    network: Network

    def model(self) -> Narx | InnovationNetwork:
        """The model.

        Raises ModelError if structure, network and limits do not fit together.
        """
        if isinstance(self.structure, InnovationStructure):
            return InnovationNetwork(self.structure, self.network, limits=self.limits)
        return Narx(self.structure, self.network, name=KIND, limits=self.limits)


def narx(*, network: str, rig: Model | None = None) -> Narx | InnovationNetwork:
    """The model of a network file.

    Raises ConfigurationError if there is no such network. Raises ModelError for a file that does
    not hold one; it names the file and the key.

    ``network``: A network that travels with the program, by name, or the path of a network file.
    ``rig``: the rig that it was trained on. A run simulates it in the place of the network; to the
    model itself it means nothing.
    """
    content = read_narx_file(network, where="model.network")
    return narx_of(content, network)


def narx_of(content: NarxFile, path: str) -> Narx | InnovationNetwork:
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
        structure=structure_from_data(data["structure"], f"{label}: structure"),
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
