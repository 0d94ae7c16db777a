"""Multiple-model MPC: linear MPC whose model is blended from a bank of operating points.

The nonlinear model is made linear once, at start-up, at each point of a bank. At each sample every
model i has a weight, and the quadratic program of :mod:`trms_cli.controllers.linear_mpc` takes the
blend ``A = Σ w_i A_i``, ``B = Σ w_i B_i`` for the slopes. Where it starts from is a period of the
nonlinear model under the last command, where it ends is that model's steady state of the reference:
there is no offset, whatever the weights.

- ``distance``: ``w_i ∝ exp(−½ ‖(α − α_i)/width‖²)`` of the estimated angles, a schedule.
- ``bayes``: recursive probabilities of the residuals ε of each model's prediction over the last
  period, ``w_i ∝ w_i⁻ exp(−½ ‖ε_i/σ‖²)``, each at least ``least_probability``, so that a model
  that has been wrong can come back. σ is a share of the typical size of each state.

The angles alone do not say in which direction the tail rotor turns, on whose speed the slope of its
thrust depends; the residuals do.

Sources: Magill, "Optimal adaptive estimation of sampled stochastic processes", IEEE Trans.
Automatic Control 10, 1965, for the probabilities; Aufderheide & Bequette, "Extension of dynamic
matrix control to multiple models", Computers & Chemical Engineering 27, 2003, for the bank.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

import numpy as np
from msgspec import Meta

from trms_cli.controllers.controller import ControlSample, ControlSetup
from trms_cli.controllers.linear_mpc import GivenModelState, LinearMpc, Way
from trms_cli.controllers.newton.problem import typical_sizes
from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.qp import Daqp, QpSolver
from trms_cli.core.ranges import Positive
from trms_cli.models.linearisation import Linearisation, require_drivable

#: Squared distances beyond the nearest model's that still make a difference to a weight.
_FARTHEST = 600.0


def _points() -> list[Mapping[str, float]]:
    return [{"alpha_v": pitch, "alpha_h": yaw} for pitch in (-0.3, 0.0, 0.3) for yaw in (-0.5, 0.5)]


@dataclass(frozen=True, kw_only=True)
class MultipleModelMpc(LinearMpc):
    """Multiple-model MPC."""

    #: Controlled angles at which the models of the bank are taken, rad, with both rotors turning;
    #: ``operating_point`` is that of the cost beyond the horizon
    bank: list[Mapping[str, float]] = field(default_factory=_points)
    weighting: Literal["distance", "bayes"] = "bayes"
    width: Mapping[str, Positive] = field(
        default_factory=lambda: {"alpha_v": 0.2, "alpha_h": 0.3}
    )  #: Of ``distance``, rad; an angle without one does not count
    #: σ of ``bayes``, share of the states' typical sizes
    residual_share: Positive = 0.01
    #: Least weight of a model of ``bayes``
    least_probability: Annotated[float, Meta(gt=0, lt=0.5)] = 0.01
    qp: QpSolver = field(default_factory=Daqp)

    #: The prediction is exact at the present; the blend stands in the place of the slopes there.
    linearisation: ClassVar[Way] = "current"  # type: ignore[misc]

    def init(self, setup: ControlSetup) -> "MultipleModelState":
        """The bank, beside the linear MPC in NumPy.

        Raises ConfigurationError as :class:`~trms_cli.controllers.linear_mpc.LinearMpc` does, for
        each point of the bank, and for a bank without any.
        """
        return MultipleModelState(self, setup)


class MultipleModelState(GivenModelState):
    """The bank and its weights besides.

    ``A``, ``B``: (m, n, n), (m, n, n_u); of each model. ``weights``: (m,); they add up to one.
    """

    def __init__(self, config: MultipleModelMpc, setup: ControlSetup) -> None:
        super().__init__(config, setup)
        self._bank = config
        model, count = setup.model, len(config.bank)
        if not count or count * config.least_probability >= 1.0:
            raise ConfigurationError(
                f"{count} models, each of a weight of {config.least_probability:g} or more",
                where="controller.bank" if not count else "controller.least_probability",
                remedy="give one point or more, and a least weight below one over their number",
            )
        linearisation = Linearisation(model, setup.sample_time, self.steady_state)
        members = []
        for i, point in enumerate(config.bank):
            key = f"controller.bank[{i}]"
            members.append(linearisation.at(point, key))
            require_drivable(members[-1], key)
        self.A = np.array([member.A for member in members])
        self.B = np.array([member.B for member in members])
        # Where each is exact, to predict x⁺ = x_i + A_i (x − x_i) + B_i (u − u_i).
        self._states = np.array(
            [member.discrete.initial(member.target.x, member.target.u) for member in members]
        )
        self._inputs = np.array([member.target.u for member in members])
        self.weights = np.full(count, 1.0 / count)
        self._deviation = config.residual_share * typical_sizes(self.discrete)
        self._angles = [
            (model.state_index(name), config.width[name])
            for name in model.controlled
            if name in config.width
        ]
        self._before: FloatArray | None = None

    def begin_sample(self, sample: ControlSample) -> None:
        """As linear MPC; and what each model expected of this sample gives it its weight."""
        before = self._before
        super().begin_sample(sample)
        if not self.inputs_finite:
            self._before = None
            return
        distance = self._residuals(before) if self._bank.weighting == "bayes" else self._distances()
        self._before = self._full.copy()
        if distance is None:
            return
        exponent = -0.5 * np.minimum(distance - distance.min(), _FARTHEST)
        prior = self.weights if self._bank.weighting == "bayes" else 1.0
        weights = prior * np.exp(exponent)
        weights /= weights.sum()
        if self._bank.weighting == "bayes":
            least = self._bank.least_probability
            weights = least + (1.0 - least * len(weights)) * weights
        self.weights = weights

    def _residuals(self, before: FloatArray | None) -> FloatArray | None:
        """Squared residuals of each model over the last period, (m,); None where there is none."""
        if before is None:
            return None
        n_x = self.model.n_x
        after = self._states + np.einsum("mij,mj->mi", self.A, before - self._states)
        after += np.einsum("mij,mj->mi", self.B, self._last_command - self._inputs)
        residual = (self._full - after)[:, :n_x] / self._deviation
        squares = np.square(np.clip(residual, -1e6, 1e6)).sum(axis=1)
        return np.asarray(squares)

    def _distances(self) -> FloatArray:
        """Squared distances of the estimated angles from each point, in widths, (m,)."""
        squares = np.zeros(len(self.weights))
        for row, width in self._angles:
            away = (self._full[row] - self._states[:, row]) / width
            squares += np.square(np.clip(away, -1e6, 1e6))
        return squares

    def prepare_model(self) -> None:
        """The blend, and from there as linear MPC."""
        self._operating = (
            np.tensordot(self.weights, self.A, 1),
            np.tensordot(self.weights, self.B, 1),
        )
        super().prepare_model()
