"""Methods ``rbf`` and ``wavelet``: radial networks on one-step errors.

First the units are placed from the data and the linear weights solved for; then, on request, all
weights are trained together.

With q = ‖z − c‖²/d², e = exp(−q/2) and m the dimension of z,

    rbf      g = e                 ∂g/∂q = −e/2
    wavelet  g = (m − q) e         ∂g/∂q = −e − (m − q) e/2

and ∂q/∂z = 2 (z − c)/d² = −∂q/∂c, ∂q/∂log d = −2 q. The widths are free as their logarithms, so
that no step of a training can turn one negative.

Three ways to choose centres and widths from data:

- k-means (``scipy.cluster.vq``): centres of clusters, the width of each the distance to its
  nearest neighbours (Moody & Darken 1989, Neural Computation 1).
- orthogonal least squares (Chen, Cowan & Grant 1991, IEEE Trans. Neural Networks 2(2)): of many
  candidates, one after another, the one that explains most of what is left of the targets.
- a dyadic grid (Zhang & Benveniste 1992; Zhang 1997): wavelets on grids that halve their spacing
  from level to level, those that data fall into; then selected as above.

The linear weights follow from linear least squares.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from time import process_time
from typing import Annotated, ClassVar, Literal

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.identification.blackbox import network_fit
from trms_cli.identification.blackbox.prediction_error import TrainingObjective
from trms_cli.identification.blackbox.trainable import layout_of
from trms_cli.identification.blackbox.training.training import (
    EpochReport,
    Stopping,
    TrainingAlgorithm,
    TrainingOutcome,
)
from trms_cli.identification.problem import FitProblem, FitResult, Progress


@dataclass(frozen=True)
class Radial:
    """Radial units beside a direct linear part."""

    kind: Literal["rbf", "wavelet"]
    n_regressors: int
    n_outputs: int
    n_units: int

    @cached_property
    def _layout(self) -> dict[str, tuple[slice, tuple[int, ...]]]:
        return layout_of(
            {
                "centres": (self.n_units, self.n_regressors),
                "widths": (self.n_units,),
                "W": (self.n_outputs, self.n_units),
                "A": (self.n_outputs, self.n_regressors),
                "b": (self.n_outputs,),
            }
        )

    @property
    def n_parameters(self) -> int:
        return self._layout["b"][0].stop

    def weights(self, theta: FloatArray) -> dict[str, FloatArray]:
        w = self._blocks(theta)
        return w | {"widths": np.exp(w["widths"])}

    def parameter_vector(self, weights: dict[str, FloatArray]) -> FloatArray:
        """The vector θ of named weights (widths as they are, not as logarithms)."""
        blocks = weights | {"widths": np.log(weights["widths"])}
        return np.concatenate([np.ravel(blocks[name]) for name in self._layout])

    def units(self, centres: FloatArray, widths: FloatArray, z: FloatArray) -> FloatArray:
        """Activations of radial units, ``(n_c, m), (n_c,), (n, m) -> (n, n_c)``."""
        return self._profile(_squares(z, centres) / widths**2)[0]

    def values(self, theta: FloatArray, z: FloatArray) -> FloatArray:
        w = self.weights(theta)
        return self.units(w["centres"], w["widths"], z) @ w["W"].T + z @ w["A"].T + w["b"]

    def slopes(self, theta: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        w = self.weights(theta)
        n, n_out = len(z), self.n_outputs
        q = _squares(z, w["centres"]) / w["widths"] ** 2
        g, dg = self._profile(q)
        offset = (z[:, None, :] - w["centres"]) / (w["widths"] ** 2)[:, None]  # (n, n_c, m)
        by_q = w["W"][None] * dg[:, None, :]  # ∂y/∂q: (n, n_out, n_c)
        jacobian = np.zeros((n, n_out, self.n_parameters))
        at = {name: place for name, (place, _) in self._layout.items()}
        centres = -2.0 * by_q[:, :, :, None] * offset[:, None, :, :]
        jacobian[:, :, at["centres"]] = centres.reshape(n, n_out, -1)
        jacobian[:, :, at["widths"]] = -2.0 * by_q * q[:, None, :]
        for o in range(n_out):
            first = at["W"].start + o * self.n_units
            jacobian[:, o, first : first + self.n_units] = g
            first = at["A"].start + o * self.n_regressors
            jacobian[:, o, first : first + self.n_regressors] = z
            jacobian[:, o, at["b"].start + o] = 1.0
        by_z = 2.0 * np.matmul(by_q, offset) + w["A"]
        return g @ w["W"].T + z @ w["A"].T + w["b"], jacobian, by_z

    def pulled_back(
        self, theta: FloatArray, z: FloatArray, weight: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        w = self.weights(theta)
        q = _squares(z, w["centres"]) / w["widths"] ** 2
        g, dg = self._profile(q)
        by_q = (weight @ w["W"]) * dg  # (n, n_c)
        result = np.empty_like(theta)
        slope = self._blocks(result)  # views
        scale = (2.0 / w["widths"] ** 2)[:, None]
        slope["centres"][...] = scale * (by_q.sum(axis=0)[:, None] * w["centres"] - by_q.T @ z)
        slope["widths"][...] = -2.0 * np.sum(by_q * q, axis=0)
        slope["W"][...] = weight.T @ g
        slope["A"][...] = weight.T @ z
        slope["b"][...] = weight.sum(axis=0)
        scaled = by_q * (2.0 / w["widths"] ** 2)
        by_z = z * scaled.sum(axis=1, keepdims=True) - scaled @ w["centres"] + weight @ w["A"]
        return result, by_z

    def _blocks(self, theta: FloatArray) -> dict[str, FloatArray]:
        return {name: theta[at].reshape(shape) for name, (at, shape) in self._layout.items()}

    def _profile(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The radial profile and its slope in q."""
        bell = np.exp(-0.5 * q)
        if self.kind == "rbf":
            return bell, -0.5 * bell
        hat = (self.n_regressors - q) * bell
        return hat, -bell - 0.5 * hat


def _squares(z: FloatArray, centres: FloatArray) -> FloatArray:
    """Squared distances by one matrix product, ``(n, m), (n_c, m) -> (n, n_c)``."""
    inner = z @ centres.T
    squares = (z**2).sum(axis=1)[:, None] + (centres**2).sum(axis=1) - 2.0 * inner
    return np.asarray(np.maximum(squares, 0.0))


#: Neighbours whose mean distance is a cluster's width.
_NEIGHBOURS = 3
#: Cells around a sample of a grid of many dimensions: only the nearest is taken beyond this.
_MOST_CORNERS = 4


def cluster_centres(
    z: FloatArray, units: int, width: float, generator: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Centres (n_c, m) of k-means clusters and their widths (n_c,), ``width`` times the spacing."""
    from scipy.cluster.vq import kmeans2

    centres, _ = kmeans2(z, units, minit="++", seed=generator, missing="warn")
    distances = np.sqrt(((centres[:, None, :] - centres[None, :, :]) ** 2).sum(axis=2))
    neighbours = np.sort(distances, axis=1)[:, 1 : 1 + min(_NEIGHBOURS, units - 1)]
    spacing = neighbours.mean(axis=1) if units > 1 else np.full(1, np.sqrt(z.shape[1]))
    return centres, width * np.maximum(spacing, 1e-3)


def dyadic(z: FloatArray, levels: int) -> tuple[FloatArray, FloatArray]:
    """Candidates (n_c, m), (n_c,) on grids of spacing 2, 1, ½ … where data fall.

    Regressors are normalised, so the first level has a wavelet of the width of the data's
    spread; the dilation is the spacing times the square root of the dimension, with which the
    radial wavelet covers its cell.
    """
    dimension = z.shape[1]
    centres, widths = [], []
    for level in range(levels):
        spacing = 2.0 ** (1 - level)
        cells = np.unique(np.round(z / spacing).astype(np.int64), axis=0)
        if dimension <= _MOST_CORNERS:
            around = np.array(list(product((-1, 0, 1), repeat=dimension)))
            cells = np.unique((cells[:, None, :] + around[None]).reshape(-1, dimension), axis=0)
        centres.append(cells * spacing)
        widths.append(np.full(len(cells), spacing * np.sqrt(dimension)))
    return np.vstack(centres), np.concatenate(widths)


def select_columns(
    candidates: FloatArray, targets: FloatArray, fixed: FloatArray, units: int
) -> list[int]:
    """Columns chosen by orthogonal least squares, in the order of what they explain.

    The error reduction ratio of a column q, orthogonal to the chosen ones, is the share of the
    targets' sum of squares that it explains, ``Σ_o (qᵀt_o)² / qᵀq``.

    ``candidates``: (n, n_c) array; outputs of the candidates. ``targets``: (n, n_out) array.
    ``fixed``: (n, k) array; columns that are in the model anyway: a constant, the linear part.
    ``units``: columns to choose; fewer where the rest explains nothing.
    """
    basis, _ = np.linalg.qr(fixed)
    q = candidates - basis @ (basis.T @ candidates)
    rest = targets - basis @ (basis.T @ targets)
    sizes = (candidates**2).sum(axis=0)
    selection: list[int] = []
    for _ in range(min(units, candidates.shape[1])):
        squares = (q**2).sum(axis=0)
        usable = squares > 1e-8 * sizes  # else it is a sum of those already chosen
        gain = np.where(usable, ((q.T @ rest) ** 2).sum(axis=1) / np.maximum(squares, 1e-300), 0.0)
        best = int(np.argmax(gain))
        if not gain[best] > 0:
            break
        selection.append(best)
        direction = q[:, best] / np.sqrt(squares[best])
        q = q - np.outer(direction, direction @ q)
        rest = rest - np.outer(direction, direction @ rest)
        q[:, best] = 0.0
    return selection


def with_linear_weights(
    network: Radial,
    centres: FloatArray,
    widths: FloatArray,
    z: FloatArray,
    targets: FloatArray,
    ridge: float,
) -> FloatArray:
    """θ with the output weights, the linear part and the constant by (ridge) least squares.

    ``ridge`` is relative to the mean square of the columns.
    """
    g = network.units(centres, widths, z)
    columns = np.hstack([g, z, np.ones((len(z), 1))])
    gram = columns.T @ columns
    gram.flat[:: len(gram) + 1] += ridge * float(np.trace(gram)) / len(gram)
    weights = np.linalg.solve(gram, columns.T @ targets).T
    n_c, m = centres.shape
    return network.parameter_vector(
        {
            "centres": centres,
            "widths": widths,
            "W": weights[:, :n_c],
            "A": weights[:, n_c : n_c + m],
            "b": weights[:, -1],
        }
    )


#: Candidates of a selection, and samples that they are judged on: more cost time and tell little.
_MOST_CANDIDATES, _MOST_SAMPLES = 600, 4000


@dataclass(frozen=True, kw_only=True)
class RadialFit:
    """A network of radial units beside a linear part."""

    kind: Literal["rbf", "wavelet"]
    training: TrainingAlgorithm
    placement: Literal["kmeans", "ols", "dyadic"] = "kmeans"  #: How centres and widths begin
    units: Annotated[int, Meta(ge=1, le=1000)] = 20
    #: Width over the distance to the neighbours (kmeans), or over the spread of the data (ols)
    width: Annotated[float, Meta(gt=0)] = 1.0
    levels: Annotated[int, Meta(ge=1, le=6)] = 3  #: Grids of the dyadic placement
    ridge: Annotated[float, Meta(ge=0)] = 1e-8  #: Of the linear least squares, relative
    tune: bool = True  #: Whether all weights are then trained by ``training``
    regressors: network_fit.Regressors = field(default_factory=network_fit.Regressors)
    stopping: Stopping = field(default_factory=Stopping)

    fits_parameters: ClassVar[bool] = False

    def fit(self, problem: FitProblem, progress: Progress) -> FitResult:
        """Fit the problem; see :class:`trms_cli.identification.problem.Method`."""
        data = network_fit.prepare_fit(self.regressors, problem, self.training)
        begin = process_time()
        network, theta = self.placed(data, problem.seed)
        placing = process_time() - begin
        stopping = self.stopping if self.tune else Stopping(epochs=1)
        algorithm: TrainingAlgorithm = self.training if self.tune else _AsPlaced()
        watcher = network_fit.training_watcher(progress, 0.0, 1.0, stopping, "one step")
        training = data.train_one_step(network, algorithm, theta, stopping, watcher)
        if not self.tune:
            training = replace(training, outcome=TrainingOutcome.GOAL)
        return network_fit.fit_result(
            self.kind, problem, data, network, [network_fit.Stage("one step", training, placing)]
        )

    def placed(self, data: network_fit.NetworkData, seed: int) -> tuple[Radial, FloatArray]:
        """The network with its units placed and its linear weights solved for."""
        generator = np.random.default_rng(np.random.SeedSequence([seed, 0x52414449]))
        z, targets = data.normalised(data.fitted_smooth)
        n_out = targets.shape[1]
        if self.placement == "kmeans":
            centres, widths = cluster_centres(z, min(self.units, len(z)), self.width, generator)
        else:
            few = _draw_indices(len(z), _MOST_SAMPLES, generator)
            if self.placement == "ols":
                centres = z[_draw_indices(len(z), _MOST_CANDIDATES, generator)]
                widths = np.full(len(centres), self.width * np.sqrt(z.shape[1]))
            else:
                centres, widths = dyadic(z, self.levels)
                draw = _draw_indices(len(centres), _MOST_CANDIDATES, generator)
                centres, widths = centres[draw], widths[draw]
            family = Radial(self.kind, z.shape[1], n_out, len(centres))
            outputs = family.units(centres, widths, z[few])
            fixed = np.hstack([z[few], np.ones((len(few), 1))])
            selection = select_columns(outputs, targets[few], fixed, self.units)
            centres, widths = centres[selection], widths[selection]
        network = Radial(self.kind, z.shape[1], n_out, len(centres))
        return network, with_linear_weights(network, centres, widths, z, targets, self.ridge)


class _AsPlaced(TrainingAlgorithm):
    """No training: the placed units with their linear weights."""

    regularised = True

    def minimise(
        self, objective: TrainingObjective, start: FloatArray, report: EpochReport
    ) -> None:
        return


def _draw_indices(n: int, most: int, generator: np.random.Generator) -> np.ndarray:
    """Up to ``most`` of n indices, in order."""
    if n <= most:
        return np.arange(n)
    return np.sort(generator.choice(n, most, replace=False))
