"""Method ``genetic_structure``: a genetic algorithm chooses a polynomial's terms and coefficients.

An ARX (``degree`` 1) or a polynomial NARX model: each output's change over a sample is a sum of
monomials of past outputs and commands,

    y_i(k) − y_i(k−1) = Σ_t θ_it m_t(φ(k))      φ: y(k−1), differences of its lags, u(k−m)

For every output and candidate term an individual has two genes: whether the term is there (from ½
on), and by how much its coefficient departs from that of least squares over the terms that are
there, within ``spread`` of its standard deviations. Least squares one step ahead takes the noise of
the outputs for motion; what is told from simulations corrects it. The cost is the mean square of
simulations over windows of ``horizon``, each output in units of its spread, raised by
``term_price`` for each term: a term has to earn its place.

The first generation has least squares over terms chosen by orthogonal least squares (error
reduction ratios), some dozen sizes of model, and draws about these.

Sources: S. Chen, S. A. Billings & W. Luo 1989, "Orthogonal least squares methods and their
application to non-linear system identification", Int. J. Control 50(5); C. M. Fonseca, E. M.
Mendes, P. J. Fleming & S. A. Billings 1993, "Non-linear model term selection with genetic
algorithms", IEE/IEEE Workshop on Natural Algorithms in Signal Processing.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import combinations_with_replacement
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import BoolArray, FloatArray, IntArray
from trms_cli.identification.blackbox.network_fit import (
    NetworkData,
    Regressors,
    errors_of,
    prepare_samples,
)
from trms_cli.identification.blackbox.prediction_error import MultiStepError
from trms_cli.identification.blackbox.radial_fit import select_columns
from trms_cli.identification.blackbox.trainable import Mlp
from trms_cli.identification.genetic import Genetic, GeneticSearch, Probability
from trms_cli.identification.linear.linear_data import LinearData
from trms_cli.identification.population import Journal, SearchResult, evolve
from trms_cli.identification.problem import (
    FitOutcome,
    FitProblem,
    FitResult,
    HistoryPoint,
    Progress,
)
from trms_cli.models.linear_file import LinearFile
from trms_cli.models.narx_file import NarxFile
from trms_cli.models.network import NarxStructure, Network
from trms_cli.models.state_space import DiscreteStateSpace

#: Of the largest column's mean square, added to every diagonal entry: collinear lags stay apart.
_RIDGE = 1e-9
#: Terms of the models that begin the search, as shares of the candidates.
_FIRST_SHARES = (1.0, 0.7, 0.5, 0.35, 0.25, 0.15)
#: Samples that an orthogonal selection looks at, and how often a drawn term differs from it.
_MOST_SAMPLES, _FLIPS = 4000, 0.1


@dataclass(frozen=True)
class Monomials:
    """All monomials up to a degree: the constant first, then degree by degree."""

    exponents: IntArray  #: (n_terms, n_phi)
    parents: IntArray  #: (n_terms,), the monomial that each is one factor more than
    factors: IntArray  #: (n_terms,), that factor
    degrees: IntArray  #: (n_terms,)

    @classmethod
    def up_to(cls, n_regressors: int, degree: int) -> "Monomials":
        combinations = [
            c
            for d in range(degree + 1)
            for c in combinations_with_replacement(range(n_regressors), d)
        ]
        place = {c: i for i, c in enumerate(combinations)}
        exponents = np.zeros((len(combinations), n_regressors), dtype=np.int64)
        for i, combination in enumerate(combinations):
            for j in combination:
                exponents[i, j] += 1
        return cls(
            exponents,
            np.array([place[c[:-1]] if c else 0 for c in combinations]),
            np.array([c[-1] if c else 0 for c in combinations]),
            exponents.sum(axis=1),
        )

    def __len__(self) -> int:
        return len(self.degrees)

    def values(self, z: FloatArray) -> FloatArray:
        """The monomials of normalised regressors, (…, n_phi) to (…, n_terms)."""
        result = np.ones((*z.shape[:-1], len(self)))
        for degree in range(1, int(self.degrees.max()) + 1):
            here = self.degrees == degree
            result[..., here] = result[..., self.parents[here]] * z[..., self.factors[here]]
        return result


class SimulatedPolynomials:
    """Costs of many polynomials at once, over windows of the fitted recordings.

    ``windows``: made for any network of the same structure; its samples are taken.
    """

    def __init__(
        self, data: NetworkData, candidates: Monomials, windows: MultiStepError, spread: float
    ) -> None:
        self.data, self.candidates, self._windows, self.spread = data, candidates, windows, spread
        z, targets = data.normalised(data.fitted_smooth)
        columns = candidates.values(z)
        self._count, self._targets = len(z), targets
        self._gram = columns.T @ columns
        self._crossed = columns.T @ targets
        self._squares = np.sum(targets**2, axis=0)

    def coefficients(self, present: BoolArray, moves: FloatArray) -> FloatArray:
        """Coefficients (m, n_y, n_terms) of individuals; zero where a term is absent.

        ``present``, ``moves``: (m, n_y, n_terms) arrays; the latter in −1 to 1, of ``spread``
        standard deviations of least squares.
        """
        there = present.astype(float)
        gram = self._gram * there[..., :, None] * there[..., None, :]
        ridge = _RIDGE * self._gram.diagonal().max()
        gram += np.einsum("moi,ij->moij", 1.0 - there, np.eye(there.shape[-1]))
        gram += ridge * np.eye(there.shape[-1])
        inverse = np.linalg.inv(gram)
        theta = np.einsum("moij,moj->moi", inverse, there * self._crossed.T)
        explained = np.einsum("moi,oi->mo", theta * there, self._crossed.T)
        rest = np.maximum(self._squares - explained, 0.0) / self._count
        sd = np.sqrt(rest[..., None] * np.einsum("moii->moi", inverse))
        return np.asarray(there * (theta + self.spread * moves * sd))

    def errors(self, theta: FloatArray) -> FloatArray:
        """Mean squared simulation errors of models (m, n_y, n_terms), in units of the spreads."""
        return simulated_errors(self._windows, self.candidates, theta)


def simulated_errors(
    windows: MultiStepError, candidates: Monomials, theta: FloatArray
) -> FloatArray:
    """As :meth:`SimulatedPolynomials.errors`; infinite after a divergence, (m,)."""
    structure, scaling = windows.structure, windows.scaling
    past, inputs, targets, present = windows.samples
    first = structure.longest_lag
    levels = np.empty((len(inputs), len(theta), *past.shape[1:]))
    levels[:first] = past[:, None]
    weights = theta.swapaxes(1, 2)
    arrangement = structure.arrangement().T
    squares = np.zeros(len(theta))
    shape = (len(theta), *inputs.shape[1:])
    with np.errstate(all="ignore"):
        for k in range(first, len(inputs)):
            lagged = [levels[k - lag] for lag in structure.output_lags]
            lagged += [np.broadcast_to(inputs[k - lag], shape) for lag in structure.input_lags]
            regressor = np.concatenate(lagged, axis=-1) @ arrangement
            z = (regressor - scaling.regressor_mean) / scaling.regressor_sd
            change = np.matmul(candidates.values(z), weights)
            levels[k] = scaling.output_mean + scaling.output_sd * change
            if structure.incremental:
                levels[k] += levels[k - 1]
            error = (levels[k] - targets[k - first]) / scaling.level_sd
            squares += np.sum(np.where(present[k - first], error, 0.0) ** 2, axis=(1, 2))
    mean = squares / windows.n_residuals
    return np.where(np.isfinite(mean), mean, np.inf)


@dataclass(frozen=True, kw_only=True)
class GeneticStructure:
    """Terms and coefficients of a polynomial model by a genetic algorithm."""

    degree: Annotated[int, Meta(ge=1, le=3)] = 1  #: Of the monomials; 1: an ARX model
    regressors: Regressors = field(
        default_factory=lambda: Regressors(output_lags=(1, 2, 4, 8), input_lags=(1, 2))
    )
    horizon: Annotated[float, Meta(gt=0)] = 4.0  #: s, of the simulated windows
    windows: Annotated[int, Meta(ge=1)] = 60  #: At the most, spread over the recordings
    #: Share by which a term has to lower the mean squared error
    term_price: Annotated[float, Meta(ge=0)] = 1e-3
    #: Standard deviations of least squares by which a coefficient may differ from it
    spread: Annotated[float, Meta(ge=0)] = 10.0
    individuals: Annotated[int, Meta(ge=12)] = 60  #: Of a generation
    generations: Annotated[int, Meta(ge=1)] = 100
    crossover: Literal["simulated_binary", "uniform", "two_point"] = "uniform"
    crossover_probability: Probability = 0.9  #: Of a pair of parents
    #: Of each gene of a child; None: one over their number
    mutation_probability: Probability | None = None

    fits_parameters: ClassVar[bool] = False

    def fit(self, problem: FitProblem, progress: Progress) -> FitResult:
        """Fit the problem; see :class:`trms_cli.identification.problem.Method`."""
        data = prepare_samples(self.regressors, problem)
        candidates = Monomials.up_to(data.structure.n_regressors, self.degree)
        polynomials = SimulatedPolynomials(
            data, candidates, self._windows(data, "fitted"), self.spread
        )
        shape = (len(data.structure.outputs), len(candidates))
        random = np.random.default_rng(np.random.SeedSequence([problem.seed, 0x47454E45]))
        first = self._first(polynomials, shape, random)
        search = GeneticSearch(
            first,
            problem.seed,
            Genetic(
                individuals=self.individuals,
                crossover=self.crossover,
                crossover_probability=self.crossover_probability,
                mutation_probability=self.mutation_probability,
            ),
        )

        def evaluate(points: FloatArray) -> FloatArray:
            present, moves = _decoded(points, shape)
            theta = polynomials.coefficients(present, moves)
            costs = polynomials.errors(theta)
            costs *= 1.0 + self.term_price * present.sum(axis=(1, 2))
            if self.degree == 1:
                radii = [spectral_radius(data.lags, data, t) for t in theta]
                costs[np.array(radii) >= 1.0] = np.inf
            return costs

        settings = asdict(self)
        budget = self.individuals * settings.pop("generations")
        about = {
            "method": "genetic_structure",
            **settings,
            "seed": problem.seed,
            "recordings": [[d.sha256, len(d), d.sample_time] for d in problem.datasets],
        }
        journal = Journal(about, progress.saved())

        def watch(result: SearchResult) -> bool:
            progress.save(journal.state)
            message = f"generation {len(result.costs)}, cost {result.cost:.4g}"
            return progress.update(result.evaluations / budget, result.cost, message)

        result = evolve(
            search,
            evaluate,
            evaluations=budget,
            dimension=first.shape[1],
            journal=journal,
            watch=watch,
        )
        outcome = FitOutcome.BUDGET_SPENT
        if not np.isfinite(result.cost):
            outcome = FitOutcome.FAILED
        elif result.stopped:
            outcome = FitOutcome.INTERRUPTED
        present, moves = _decoded(result.best[None], shape)
        theta = polynomials.coefficients(present, moves)[0]
        record = self._record(problem, data, candidates, present[0], theta, result)
        return FitResult(
            method="genetic_structure",
            outcome=outcome,
            cost=result.cost,
            history=[
                HistoryPoint((i + 1) * self.individuals, entry.seconds, best)
                for i, (entry, (best, _)) in enumerate(
                    zip(journal.generations, result.costs, strict=True)
                )
            ],
            evaluations=result.evaluations,
            seconds=result.seconds,
            model_document=self._document(problem, data, candidates, theta, record),
            details=record,
        )

    def _windows(self, data: NetworkData, part: Literal["fitted", "validation"]) -> MultiStepError:
        steps = max(1, round(self.horizon / data.structure.sample_time))
        samples = sum(len(recording) for recording in getattr(data, part))
        stride = max(steps, samples // self.windows)
        structure = data.structure
        # any network: only the windows' samples are taken
        network = Mlp(structure.n_regressors, len(structure.outputs), ())
        return data.simulation(network, steps, part, stride)

    def _first(
        self, polynomials: SimulatedPolynomials, shape: tuple[int, int], random: np.random.Generator
    ) -> FloatArray:
        """Models of several sizes by orthogonal least squares, and draws about them."""
        data, candidates = polynomials.data, polynomials.candidates
        z, targets = data.normalised(data.fitted_smooth)
        few = np.linspace(0, len(z) - 1, min(len(z), _MOST_SAMPLES)).astype(int)
        columns = candidates.values(z[few])
        orders = [
            select_columns(columns[:, 1:], targets[few, i : i + 1], columns[:, :1], shape[1] - 1)
            for i in range(shape[0])
        ]
        present = np.zeros((self.individuals, *shape))
        moves = np.full((self.individuals, *shape), 0.5)
        for individual in range(self.individuals):
            share = _FIRST_SHARES[individual % len(_FIRST_SHARES)]
            for i, order in enumerate(orders):
                present[individual, i, 0] = 1.0
                kept = order[: max(1, round(share * (shape[1] - 1)))]
                present[individual, i, np.array(kept) + 1] = 1.0
        drawn = slice(len(_FIRST_SHARES), None)
        flips = random.uniform(size=present[drawn].shape) < _FLIPS
        present[drawn] = np.where(flips, 1.0 - present[drawn], present[drawn])
        moves[drawn] = np.clip(random.normal(0.5, 0.1, moves[drawn].shape), 0.0, 1.0)
        # well inside their halves, so that a small mutation switches no term
        genes = np.stack([0.25 + 0.5 * present, moves], axis=1)
        return np.asarray(genes.reshape(self.individuals, -1))

    def _record(
        self,
        problem: FitProblem,
        data: NetworkData,
        candidates: Monomials,
        present: BoolArray,
        theta: FloatArray,
        result: SearchResult,
    ) -> dict[str, Any]:
        structure = data.lags
        names = regressor_words(structure)
        terms: dict[str, Mapping[str, float]] = {}
        for i, output in enumerate(structure.outputs):
            terms[output] = {
                _word(names, candidates.exponents[t]): float(theta[i, t])
                for t in np.flatnonzero(present[i])
            }
        network = _network(data, candidates, theta)
        return {
            "method": "genetic_structure",
            "seed": problem.seed,
            "degree": self.degree,
            "candidates": len(candidates),
            "terms": int(present.sum()),
            "linear": _is_linear(candidates, theta),
            "generations": len(result.costs),
            "cost_of_first_generation": float(result.costs[0][0]),
            "normalised_rms": errors_of(data, network),
            # of the normalised regressors, each output's change in units of its own
            "coefficients": terms,
        }

    def _document(
        self,
        problem: FitProblem,
        data: NetworkData,
        candidates: Monomials,
        theta: FloatArray,
        record: Mapping[str, Any],
    ) -> dict[str, Any]:
        model = problem.model
        bounds = dict(zip(data.structure.inputs, model.input_bounds()[1].tolist(), strict=True))
        stops = {name: float(stop) for name, stop in model.stops.items()}
        limits = {name: value for name, value in (bounds | stops).items() if np.isfinite(value)}
        common: dict[str, Any] = {"name": "genetic_structure", "limits": limits}
        if _is_linear(candidates, theta):
            space = linear_model(problem, data, candidates, theta)
            return LinearFile(state_space=space, training=dict(record), **common).to_data()
        return NarxFile(
            structure=data.structure,
            network=_network(data, candidates, theta),
            training=dict(record),
            **common,
        ).to_data()


def linear_model(
    problem: FitProblem, data: NetworkData, candidates: Monomials, theta: FloatArray
) -> DiscreteStateSpace:
    """The state space of linear terms, about the rest at the mean command of the recordings.

    ``theta``: (n_y, n_terms) array.
    """
    structure, first = data.lags, problem.datasets[0]
    F, G, constant = difference_equation(structure, data, theta[:, : structure.n_regressors + 1])
    u = np.vstack([samples.inputs for samples in data.fitted])
    y = np.vstack([samples.outputs for samples in data.fitted])
    operating_input = u.mean(axis=0)
    drive = G.sum(axis=0) @ operating_input + constant
    rest = np.linalg.solve(np.eye(len(constant)) - F.sum(axis=0), drive)
    # as measured: the encoder's step is part of what an observer has to weigh
    z, targets = data.normalised(data.fitted)
    residual = targets - candidates.values(z) @ theta.T
    spread, input_spread = np.nanstd(y, axis=0), u.std(axis=0)
    linear = LinearData(
        output_signals=first.outputs,
        input_signals=first.inputs,
        sample_time=structure.sample_time,
        output_mean=rest,
        input_mean=operating_input,
        output_sd=spread,
        input_sd=input_spread,
        fitted=(),
        validation=(),
    )
    return linear.lagged_state_space(
        F * spread / spread[:, None],
        G * input_spread / spread[:, None],
        residual.std(axis=0) * data.scaling.output_sd / spread,
    )


def difference_equation(
    structure: NarxStructure, data: NetworkData, theta: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """F (n_a, n_y, n_y), G (n_m, n_y, n_u) and constant (n_y,) of linear terms, in own units.

    ``theta``: (n_y, 1 + n_phi) array; of the constant and the normalised regressors.
    """
    scaling, n_y, n_u = data.scaling, len(structure.outputs), len(structure.inputs)
    slope = scaling.output_sd[:, None] * theta[:, 1:] / scaling.regressor_sd
    constant = scaling.output_mean + scaling.output_sd * theta[:, 0]
    constant = constant - slope @ scaling.regressor_mean
    lagged = slope @ structure.arrangement()
    F = np.zeros((structure.output_lags[-1], n_y, n_y))
    G = np.zeros((structure.input_lags[-1], n_y, n_u))
    split = n_y * len(structure.output_lags)
    for i, lag in enumerate(structure.output_lags):
        F[lag - 1] = lagged[:, i * n_y : (i + 1) * n_y]
    for i, lag in enumerate(structure.input_lags):
        G[lag - 1] = lagged[:, split + i * n_u : split + (i + 1) * n_u]
    if structure.incremental:
        F[0] += np.eye(n_y)
    return F, G, constant


def spectral_radius(structure: NarxStructure, data: NetworkData, theta: FloatArray) -> float:
    """Largest modulus of a pole of a linear model, ``theta`` (n_y, 1 + n_phi)."""
    F, _, _ = difference_equation(structure, data, theta)
    n_a, n_y, _ = F.shape
    companion = np.eye(n_a * n_y, k=-n_y)
    companion[:n_y] = np.hstack(list(F))
    return float(np.abs(np.linalg.eigvals(companion)).max())


def regressor_words(structure: NarxStructure) -> list[str]:
    """What each regressor is, as ``alpha_v(k-1)`` or ``alpha_v(k-1)-alpha_v(k-4)``."""
    words = []
    lags = structure.output_lags
    for i, lag in enumerate(lags):
        for name in structure.outputs:
            word = f"{name}(k-{lag})"
            if structure.differences and i:
                word = f"{name}(k-{lags[i - 1]})-{word}"
            words.append(word)
    words += [f"{name}(k-{lag})" for lag in structure.input_lags for name in structure.inputs]
    return words


def _word(names: Sequence[str], exponents: IntArray) -> str:
    factors = [f"[{names[j]}]" for j in np.repeat(np.arange(len(names)), exponents).tolist()]
    return "*".join(factors) if factors else "1"


def _decoded(points: FloatArray, shape: tuple[int, int]) -> tuple[BoolArray, FloatArray]:
    """Presence and moves (−1 to 1) of individuals (m, n), each (m, n_y, n_terms)."""
    genes = points.reshape(len(points), 2, *shape)
    return genes[:, 0] >= 0.5, 2.0 * genes[:, 1] - 1.0


def _is_linear(candidates: Monomials, theta: FloatArray) -> bool:
    return not np.any(theta[:, candidates.degrees > 1])


def _network(data: NetworkData, candidates: Monomials, theta: FloatArray) -> Network:
    """The polynomial as a network; with a term of no weight where it is linear."""
    scaling, n_z = data.scaling, data.structure.n_regressors
    bent = np.flatnonzero((candidates.degrees > 1) & np.any(theta != 0.0, axis=0))
    exponents, weights = candidates.exponents[bent].astype(float), theta[:, bent]
    if not len(bent):
        exponents, weights = np.eye(1, n_z), np.zeros((len(theta), 1))
    return Network(
        "polynomial",
        {
            "exponents": exponents,
            "W": weights,
            "A": theta[:, 1 : n_z + 1],
            "b": theta[:, 0],
        },
        scaling.regressor_mean,
        scaling.regressor_sd,
        scaling.output_mean,
        scaling.output_sd,
    )
