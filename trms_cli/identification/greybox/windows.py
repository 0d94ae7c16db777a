"""All windows of a problem's recordings, simulated at once, as whitened residuals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.identification.greybox.starts import StartEstimator, Starts, spreads
from trms_cli.identification.problem import FitProblem
from trms_cli.models.model import names
from trms_cli.simulation.rollout import Rollout

#: No residual is divided by less than this (in the output's unit).
_LEAST_SD = 1e-9


class Residuals(NamedTuple):
    """Predicted less measured, not yet divided by anything."""

    r: FloatArray  #: (m, c, n_y) array; by window, sample, output; 0 where nothing was measured
    #: (m, c, n_y, n_x + n_f) array or None; slopes in the window's start (the model's states) and
    #: in the free parameters
    j: FloatArray | None
    ends: FloatArray  #: (m, n_x) array; states one sample after each window
    dends: FloatArray | None  #: (m, n_x, n_x + n_f) array or None

    @property
    def finite(self) -> bool:
        """Whether the simulation stayed finite in all windows."""
        return bool(np.isfinite(self.r).all())


class Windows:
    """The windows of a problem's recordings, which have one sample time.

    ``with_parameters``: whether slopes in the free parameters are wanted; without them only those
    in the starts are computed, which is what a search without gradients needs. ``rollout``: of the
    problem's model, free parameters and sample time, made before; None: make it.
    """

    def __init__(
        self, problem: FitProblem, *, with_parameters: bool = True, rollout: Rollout | None = None
    ) -> None:
        self.problem, self.datasets = problem, problem.datasets
        self._check_sample_times()
        model = problem.model
        self.sample_time = self.datasets[0].sample_time
        free = problem.names if with_parameters else ()
        self.rollout = rollout or Rollout(
            model, self.sample_time, free=free, substeps=problem.substeps, jobs=problem.jobs
        )
        length, stride = problem.window_length, problem.window_stride
        if stride is not None:
            stride = min(stride, length)
        #: Weight of a squared residual: below 1 where windows overlap
        self.share = 1.0 if stride is None else stride / length
        self._commands = np.vstack([d.commands for d in self.datasets])
        firsts, counts, self._of_dataset, offset = [], [], [], 0
        for dataset in self.datasets:
            first, count = dataset.windows(length, stride)
            self._of_dataset.append((dataset, first, slice(offset, offset + len(first))))
            firsts.append(first)
            counts.append(count)
            offset += len(first)
        lengths = np.cumsum([0, *(len(d) for d in self.datasets)])
        self.first = np.concatenate([f + o for f, o in zip(firsts, lengths, strict=False)])
        self.count = np.concatenate(counts)
        #: (m,) array of bool; whether a window begins where the one before it ends
        self.follows = np.concatenate(
            [[False], self.first[1:] == self.first[:-1] + self.count[:-1]]
        )
        for _, _, rows in self._of_dataset:
            self.follows[rows.start] = False
        self.spread = spreads(model)  #: (n_x,) array; of the prior of the starts
        self._estimators = [
            StartEstimator(self.rollout, dataset, first) for dataset, first, _ in self._of_dataset
        ]
        #: (m, c) array of bool; which samples belong to a window
        self.inside: BoolArray = np.arange(int(self.count.max()))[None] < self.count[:, None]
        #: Standard deviation of each output's noise as declared, (m, n_y), and what was measured,
        #: (m, c, n_y), NaN where there is nothing to compare
        self.declared, self.target = self._measurements()
        self.measured = np.isfinite(self.target)
        if not self.measured.any():
            raise ConfigurationError(
                "the recordings hold no measured sample", where="real", remedy="look at the files"
            )

    def __len__(self) -> int:
        return len(self.first)

    @property
    def n_x(self) -> int:
        """Number of states of the model, its memory not among them."""
        return self.problem.model.n_x

    def starts(self, p: FloatArray) -> FloatArray:
        """Estimated starts of the windows, shape (m, n_x)."""
        return np.vstack([s[:, : self.n_x] for s, _ in self._estimated(p)])

    def with_memory(self, p: FloatArray, starts: FloatArray) -> FloatArray:
        """Full states (m, n): some starts of the model's states, and the memory at them."""
        return self._with_memory(p, starts)[0]

    def command(self, j: int, k: int) -> FloatArray:
        """The command at sample ``k`` of window ``j``, (n_u,); past its end that of the last."""
        sample = self.first[j] + min(k, self.count[j] - 1)
        command: FloatArray = self._commands[sample]
        return command

    @property
    def commands(self) -> FloatArray:
        """Commands of all windows, (m, c, n_u), the last repeated past a window's end."""
        k = np.minimum(np.arange(self.inside.shape[1]), self.count[:, None] - 1)
        commands: FloatArray = self._commands[self.first[:, None] + k]
        return commands

    def residuals(self, p: FloatArray, starts: FloatArray, *, slopes: bool = False) -> Residuals:
        """Simulate with all parameters ``p`` (n_p,) from ``starts`` (m, n_x)."""
        x, memory_slopes = self._with_memory(p, starts)
        if not slopes:
            y, ends = self.rollout.outputs(self._commands, self.first, self.count, x, p)
            return Residuals(self._compared(y), None, ends[:, : self.n_x], None)
        y, ends, dy, dends = self.rollout.sensitivities(
            self._commands, self.first, self.count, x, p
        )
        j = np.zeros((*self.inside.shape, *dy.shape[1:]))
        j[self.inside] = dy
        dends = dends[:, : self.n_x]
        j, dends = self._in_model_states(j, dends, memory_slopes)
        return Residuals(self._compared(y), j, ends[:, : self.n_x], dends)

    def _compared(self, y: FloatArray) -> FloatArray:
        r = np.zeros(self.target.shape)
        r[self.inside] = y
        return np.where(self.measured, r - self.target, 0.0)

    def _in_model_states(
        self, j: FloatArray, dends: FloatArray, memory_slopes: FloatArray | None
    ) -> tuple[FloatArray, FloatArray]:
        """Slopes without those in the memory, whose own slopes go to the parameters."""
        n, n_all = self.n_x, self.rollout.n_x
        if memory_slopes is None:
            return j, dends
        through = [
            np.einsum("m...k,mkf->m...f", slopes[..., n:n_all], memory_slopes)
            for slopes in (j, dends)
        ]
        j = np.concatenate([j[..., :n], j[..., n_all:] + through[0]], axis=-1)
        dends = np.concatenate([dends[..., :n], dends[..., n_all:] + through[1]], axis=-1)
        return j, dends

    def _with_memory(
        self, p: FloatArray, starts: FloatArray
    ) -> tuple[FloatArray, FloatArray | None]:
        if self.rollout.n_x == self.n_x:
            return starts, None
        x, slopes = zip(*self._estimated(p), strict=True)
        full = np.vstack(x)
        full[:, : self.n_x] = starts
        return full, np.concatenate(slopes)

    def _estimated(self, p: FloatArray) -> list[Starts]:
        return [estimator.at(p) for estimator in self._estimators]

    def _measurements(self) -> tuple[FloatArray, FloatArray]:
        """Declared noise (m, n_y) and measured outputs (m, c, n_y), NaN where there is none."""
        outputs = names(self.problem.model.outputs)
        sd = np.ones((len(self), len(outputs)))
        target = np.full((*self.inside.shape, len(outputs)), np.nan)
        for dataset, first, rows in self._of_dataset:
            columns = [outputs.index(name) for name in names(dataset.outputs)]
            sd[rows, columns] = np.maximum(dataset.noise_sd, _LEAST_SD)
            for j, begin in zip(range(rows.start, rows.stop), first, strict=True):
                n = int(self.count[j])
                target[j, :n, columns] = dataset.measurements[begin : begin + n].T
        return sd, target

    def _check_sample_times(self) -> None:
        times = {round(dataset.sample_time, 9) for dataset in self.datasets}
        if len(times) > 1:
            raise ConfigurationError(
                f"the recordings have different sample times: {sorted(times)} s",
                where="real",
                remedy="fit those of one sample time together, or resample them",
            )
