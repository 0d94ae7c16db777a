"""The force that each equation lacks, second by second, from short free runs.

A recording is cut into windows of a second. In each the model runs free from the state that the
measurements around its beginning show; by how much the measured outputs bend away from it is the
mean force that the equation lacks there:

    y − y_sim ≈ δ + f γ t²/2          an angle, γ its acceleration by a unit of torque
    y − y_sim ≈ δ + f γ t             a rotor's speed

with δ an offset of the sensor. The rate at the start is that of the measurements: left free, it
would explain away the friction that stops the model at once and not the rig. Nothing is linearised
about the motion, so that dry friction stays what it is: an axis that the model holds does not move,
whatever smaller torque is missing, and its window says nothing but that the model holds it. Errors
do not grow over the recording either: a model that drifts away within ten seconds still tells the
force that it lacks in each of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca
import numpy as np

from trms_cli.core.arrays import BoolArray, FloatArray, IntArray
from trms_cli.core.threads import SYMBOLS
from trms_cli.identification.dataset import Dataset
from trms_cli.identification.greybox.windows import Windows
from trms_cli.identification.problem import FitProblem
from trms_cli.models.model import Model, names

#: s. Length of a run: long enough that an encoder's step is a fraction of a mN m, short against
#: what happens to a rig.
LENGTH = 1.0
#: rad. An axis that moves less in the second half of its run is held.
_HELD = 4e-4
#: s at the beginning of a run that a rotor's speed is put right by, and how often.
_SETTLED, _CORRECTIONS = 0.3, 2


@dataclass(frozen=True)
class ObservableEquation:
    """A physical equation whose missing force the outputs show."""

    location: str  #: In the block diagram: the disturbance's name
    unit: str  #: Of the force
    disturbance: int  #: Position in the model's ``w``
    output: int  #: Position in the model's ``y``
    order: int  #: How often the force is integrated to the output: 2 for an angle, 1 for a speed


def observable_equations(
    model: Model, measured_outputs: Sequence[str]
) -> tuple[ObservableEquation, ...]:
    """Equations of the axes whose angles, and of the rotors whose speeds, are measured."""
    outputs, forces = names(model.outputs), names(model.disturbances)
    equations = [(axis.moment, axis.angle, 2) for axis in model.axes.values()]
    equations += [(rotor.torque, rotor.speed, 1) for rotor in model.rotors.values()]
    return tuple(
        ObservableEquation(force, model.disturbances[i].unit, i, outputs.index(output), order)
        for force, output, order in equations
        if output in outputs and output in measured_outputs and force in forces
        for i in (forces.index(force),)
    )


class MissingForces(NamedTuple):
    """Missing forces of windows."""

    force: FloatArray  #: (m, e) array; in the equations' units, NaN where nothing was measured
    at_rest: BoolArray  #: (m, e) array; the simulated axis rests, so that its force is not seen


class ShortRuns:
    """Short free runs of a model over recordings of one sample time.

    ``length``: s, of a run. ``like``: runs of the model beneath, whose forces are in the same
    measure; None: the model's own.
    """

    @SYMBOLS
    def __init__(
        self,
        model: Model,
        datasets: Sequence[Dataset],
        length: float = LENGTH,
        like: "ShortRuns | None" = None,
    ) -> None:
        self.model = model
        problem = FitProblem(model=model, datasets=tuple(datasets), window_length=length, jobs=1)
        shared_rollout = like.windows.rollout if like is not None and like.model is model else None
        windows = Windows(problem, with_parameters=False, rollout=shared_rollout)
        self.windows: Windows = windows
        measured_names = {name for dataset in datasets for name in names(dataset.outputs)}
        self.equations = observable_equations(model, sorted(measured_names))
        step, count = windows.sample_time, windows.inside.shape[1]
        whole = windows.count == count
        #: (m,) array; of each window: its recording, and its beginning in s from that one's
        self.recording: IntArray = windows.recording
        self.begin: FloatArray = windows.first_in_recording.astype(float) * step
        self.length, self._whole = count * step, whole
        self._t: FloatArray = step * np.arange(count, dtype=float)
        self._weights = np.array([_weights(self._t, e.order) for e in self.equations])
        self._gain: FloatArray = self._mobilities() if like is None else like._gain

    def __len__(self) -> int:
        return len(self.windows)

    def starts(self, p: FloatArray) -> FloatArray:
        """States at the beginnings, (m, n_x).

        A rotor's speed that is read off a polynomial is smeared where its command steps: it is put
        right by what the model itself makes of the step.
        """
        starts = self.windows.starts(p)
        rotors = [e for e in self.equations if e.order == 1]
        first = max(3, round(_SETTLED / self.windows.sample_time))
        for _ in range(_CORRECTIONS if rotors else 0):
            with np.errstate(all="ignore"):
                is_measured = self.windows.measured[:, :first]
                away = self.windows.opening_residuals(p, starts, first).sum(axis=1)
                away /= np.maximum(is_measured.sum(axis=1), 1)
            for e in rotors:
                row = self.model.state_index(self.model.outputs[e.output].name)
                starts[:, row] -= np.nan_to_num(away[:, e.output])
        return starts

    def forces(self, p: FloatArray, starts: FloatArray | None = None) -> MissingForces:
        """With all parameters at ``p``, (n_p,), from known starts (m, n_x) or estimated ones."""
        windows = self.windows
        with np.errstate(all="ignore"):
            r = windows.residuals(p, self.starts(p) if starts is None else starts).r
        outputs = [e.output for e in self.equations]
        is_measured = windows.measured[..., outputs].all(axis=1) & self._whole[:, None]
        simulated_outputs = (r + np.where(windows.measured, windows.target, 0.0))[..., outputs]
        force = -np.einsum("mce,ec->me", r[..., outputs], self._weights) / self._gain
        force = np.where(is_measured & np.isfinite(force), force, np.nan)
        late = simulated_outputs[:, len(self._t) // 2 :]
        still = np.ptp(late, axis=1) < _HELD
        return MissingForces(force, still & np.array([e.order == 2 for e in self.equations]))

    def jumps(self, shift: FloatArray, equation: int) -> FloatArray:
        """What a shift of an equation's output from some sample on adds to its force, (m, c).

        ``shift``: (m, c) array; of the measured output, by window and sample. Where a sensor jumps
        the run has begun already, and the force of a moment is all that the window shows.
        """
        weighted_shift = self._weights[equation] * np.nan_to_num(shift)
        later = np.cumsum(weighted_shift[:, ::-1], axis=1)[:, ::-1]
        return later / self._gain[:, [equation]]

    def gate(self, onset: FloatArray) -> FloatArray:
        """Share of a unit force from an onset on that each window shows, (k, m, e).

        ``onset``: (k,) array; s from the beginning of the recording of each window.
        """
        into = np.maximum(onset[:, None, None] - self.begin[:, None], 0.0)
        after = np.maximum(self._t - into, 0.0)
        shares = [
            np.einsum("kmc,c->km", after**e.order / e.order, w)
            for e, w in zip(self.equations, self._weights, strict=True)
        ]
        return np.stack(shares, axis=-1)

    def _mobilities(self) -> FloatArray:
        """What a unit of force accelerates each output by, (m, e)."""
        model = self.model
        x, u, p, w = model.symbols()
        f = model.dynamics(x, u, p, w)
        columns = []
        for e in self.equations:
            row = f[model.state_index(model.outputs[e.output].name)]
            if e.order == 2:
                row = ca.jtimes(row, x, f)
            columns.append(ca.jacobian(row, w)[e.disturbance])
        gain = ca.Function("gain", [x, u, p], [ca.substitute(ca.vertcat(*columns), w, 0 * w)])
        values = model.parameters.values
        starts = self.windows.starts(values)[:, : model.n_x]
        commands = self.windows.commands[:, 0]
        mobilities = gain.map(len(starts))(
            starts.T, commands.T, np.tile(values[:, None], len(starts))
        )
        return np.asarray(ca.DM(mobilities).full().T)


def _weights(t: FloatArray, order: int) -> FloatArray:
    """Weights (c,) whose sum with a residual is the acceleration in it, an offset left out."""
    basis = np.stack([np.ones_like(t), t**order / order], axis=1)
    return np.asarray(np.linalg.pinv(basis)[-1])
