"""Method ``torque_network``: a network that corrects a white-box model, trained on simulations.

First the model's parameters are fitted as ever (multiple shooting), without a network. Then a
perceptron whose outputs are torques on the axes is trained on simulations, by any training
algorithm of the networks, and the parameters move along: bent to make up for what the equations
lack, they have to come back as the network takes it over. What is minimised is the error over
windows, as a posterior has it,

    1/N [ Σ_t Σ_c (r_c(t)/σ_c)²  +  Σ ((x₀ − x̂₀)/s)² ]  +  φ/N [ Σ ((θ − θ₀)/s)²  +  λ Σ w² ]

with σ_c the size of the residuals that the plain fit leaves, so that it costs about 1, φ the number
of samples that say as much as one (the plain fit's), θ the parameters with their priors and w the
weights. The starts x₀ of the windows are eliminated: at every θ and w two Gauss–Newton steps from
where the plain fit has them, after which the cost's slope in them vanishes and its slope in the
rest is that of the residuals alone. Slopes are exact, through the simulated steps.

The output layer begins at zero: epoch 0 is the plain fit. Where no epoch foretells what is held out
better than that by ``least_gain``, the plain fit is what remains: a held-out part is short, and the
best of some dozen epochs is a little better on it by chance.

The idea, that a network should learn the error of the equations only: D. C. Psichogios & L. H.
Ungar 1992, AIChE Journal 38(10); that what is learnt should be judged on simulations: Nørgaard et
al. 2000, chapter 2, and Forssell & Lindskog 1997, "Combining semi-physical and neural network
modeling", IFAC SYSID.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar

import casadi as ca
import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError
from trms_cli.effects.extended_model import ExtendedModel
from trms_cli.identification.blackbox.network_fit import OUTCOMES, training_watcher
from trms_cli.identification.blackbox.prediction_error import NormalEquations
from trms_cli.identification.blackbox.trainable import Mlp
from trms_cli.identification.blackbox.training.training import (
    Stopping,
    Training,
    TrainingAlgorithm,
    train,
)
from trms_cli.identification.free_runs import error_figures, window_runs
from trms_cli.identification.greybox.windows import Residuals, Windows
from trms_cli.identification.multiple_shooting import MultipleShooting
from trms_cli.identification.problem import (
    FitOutcome,
    FitProblem,
    FitResult,
    FreeParameter,
    HistoryPoint,
    Progress,
    with_values,
)
from trms_cli.models.driven_model import DrivenModel
from trms_cli.models.model import Model, names
from trms_cli.models.network import Network
from trms_cli.models.newtonian_with_network import (
    NewtonianWithNetwork,
    TorqueNetwork,
    weight_names,
)
from trms_cli.simulation.rollout import Rollout

Units = Annotated[int, Meta(ge=1, le=200)]
#: Gauss–Newton steps to the starts of the plain fit, and from there at other weights.
_FIRST_STEPS, _STEPS = 6, 2
#: The unit of a torque: so much of what moves the axis on the recordings.
_TORQUE_SHARE = 0.1
#: Of the work that the fit of the parameters is taken for.
_SHARE_OF_PARAMETERS = 0.3


class ShootingError:
    """The error of simulated windows in parameters and weights; see the module's head.

    A :class:`trms_cli.identification.blackbox.prediction_error.TrainingObjective` of z (n_f,), the
    free parameters' deviations from their priors' centres over their scales. ``start``: z of the
    plain fit. ``prior``: (n_f,) array; φ/N of each entry of z that has a prior, times λ of a
    weight. ``sd``: (n_y,) array; σ by output of the model; None: as the residuals of the plain fit
    are, but no smaller than declared. ``like``: of the same model and free parameters, whose
    compiled simulations are taken.
    """

    def __init__(
        self,
        problem: FitProblem,
        start: FloatArray,
        *,
        prior: FloatArray | None = None,
        sd: FloatArray | None = None,
        like: "ShootingError | None" = None,
    ) -> None:
        self._problem = problem
        self._prior = np.zeros(len(start)) if prior is None else prior
        whole, plain = (None, None) if like is None else like.rollouts
        self._windows = Windows(problem, rollout=whole)
        self._plain = Windows(problem, with_parameters=False, rollout=plain)
        p = problem.all_values(self.values(start)[0])
        self._centres = self._reference = self._plain.starts(p)
        declared = self._plain.declared.min(axis=0)
        self.sd = declared if sd is None else sd
        for _ in range(_FIRST_STEPS):
            with np.errstate(all="ignore"):
                result = self._plain.residuals(p, self._reference, slopes=True)
            if sd is None and result.finite:
                self.sd = np.maximum(declared, self._size(result.r))
            step = self._start_step(result, self._reference)
            if not np.isfinite(step).all():
                break
            self._reference = self._reference + step

    @property
    def rollouts(self) -> tuple[Rollout, Rollout]:
        """The compiled simulations: with slopes in z and the starts, and in the starts alone."""
        return self._windows.rollout, self._plain.rollout

    @property
    def n_residuals(self) -> int:
        return int(np.count_nonzero(self._windows.measured))

    def values(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The free parameters' values within their bounds, and their slopes in z, each (n_f,)."""
        problem = self._problem
        lower, upper = problem.bounds
        theta = problem.prior_means + problem.scales * z
        inside = (theta > lower) & (theta < upper)
        return np.clip(theta, lower, upper), np.where(inside, problem.scales, 0.0)

    def loss(self, theta: FloatArray) -> float:
        p = self._problem.all_values(self.values(theta)[0])
        with np.errstate(all="ignore"):
            starts = self._starts(p)
            return self._loss(self._plain.residuals(p, starts), starts, theta)

    def gradient(self, theta: FloatArray) -> tuple[float, FloatArray]:
        loss, _, slope = self.normal_equations(theta)
        return loss, 2.0 * slope / self.n_residuals

    def normal_equations(self, theta: FloatArray) -> NormalEquations:
        loss, curvature, slope = self._of_data(theta)
        if np.isfinite(loss):
            prior = self._prior * self.n_residuals
            curvature.flat[:: theta.size + 1] += prior
            slope += prior * theta
        return NormalEquations(loss, curvature, slope)

    def covariance(self, z: FloatArray, samples: float) -> FloatArray:
        """Of z about the truth, (n_f, n_f), where so many samples say as much as one."""
        precision = self._of_data(z).curvature / samples + np.diag(self._prior) * (
            self.n_residuals / samples
        )
        return np.asarray(np.linalg.pinv(precision, rcond=1e-13, hermitian=True))

    def _of_data(self, theta: FloatArray) -> NormalEquations:
        """The loss; and the normal equations without the priors of z."""
        values, scales = self.values(theta)
        p, size = self._problem.all_values(values), theta.size
        with np.errstate(all="ignore"):
            starts = self._starts(p)
            result = self._windows.residuals(p, starts, slopes=True)
            loss = self._loss(result, starts, theta)
        curvature, slope = np.zeros((size, size)), np.zeros(size)
        if not np.isfinite(loss):
            return NormalEquations(loss, curvature, slope)
        assert result.j is not None
        n, root = self._windows.n_x, self._windows.measured / self.sd
        units = np.concatenate([self._windows.spread, scales])
        for r, j, weight in zip(result.r, result.j, root, strict=True):
            rows = (j * weight[..., None]).reshape(-1, n + size) * units
            in_start, in_theta = rows[:, :n], rows[:, n:]
            crossed = in_start.T @ in_theta
            curvature += in_theta.T @ in_theta
            # the start follows
            curvature -= crossed.T @ np.linalg.solve(in_start.T @ in_start + np.eye(n), crossed)
            slope += in_theta.T @ (r * weight).ravel()
        return NormalEquations(loss, curvature, slope)

    def _starts(self, p: FloatArray) -> FloatArray:
        starts = self._reference
        for _ in range(_STEPS):
            result = self._plain.residuals(p, starts, slopes=True)
            starts = starts + self._start_step(result, starts)
        return starts

    def _start_step(self, result: Residuals, starts: FloatArray) -> FloatArray:
        """One Gauss–Newton step of the starts, (m, n_x)."""
        assert result.j is not None
        windows, n = self._plain, self._plain.n_x
        root = windows.measured / self.sd
        slopes = result.j[..., :n] * windows.spread * root[..., None]
        a = np.ascontiguousarray(slopes.reshape(len(windows), -1, n))
        b = (result.r * root).reshape(len(windows), -1)
        normal = np.einsum("mki,mkj->mij", a, a) + np.eye(n)
        right = np.einsum("mki,mk->mi", a, b) + (starts - self._centres) / windows.spread
        if not (np.isfinite(normal).all() and np.isfinite(right).all()):
            return np.full_like(starts, np.nan)
        return np.asarray(-np.linalg.solve(normal, right[..., None])[..., 0] * windows.spread)

    def _size(self, r: FloatArray) -> FloatArray:
        """Root mean square of each output's residuals (m, c, n_y)."""
        count = np.maximum(self._plain.measured.sum(axis=(0, 1)), 1)
        return np.asarray(np.sqrt(np.sum(r**2, axis=(0, 1)) / count))

    def _loss(self, result: Residuals, starts: FloatArray, theta: FloatArray) -> float:
        squares = float(np.sum((result.r / self.sd) ** 2))
        squares += float(np.sum(((starts - self._centres) / self._plain.spread) ** 2))
        loss = squares / self.n_residuals + float(np.sum(self._prior * theta**2))
        return loss if np.isfinite(loss) else np.inf


@dataclass(frozen=True, kw_only=True)
class TorqueNetworkFit:
    """A fit of the parameters, then a network of torques."""

    training: TrainingAlgorithm
    parameters: MultipleShooting = field(default_factory=MultipleShooting)
    hidden: tuple[Units, ...] = (4,)  #: tanh units of each hidden layer
    #: What the network is of; None: angles, their rates, rotor speeds and commands
    regressors: tuple[str, ...] | None = None
    #: λ: one over the variance of a weight before the data; an algorithm that regularises itself
    #: has none
    weight_decay: Annotated[float, Meta(ge=0)] = 1.0
    joint: bool = True  #: Whether the parameters move with the weights; else only the weights
    #: Share by which the squared error on what is held out has to fall, or the plain fit is kept
    least_gain: Annotated[float, Meta(ge=0, lt=1)] = 0.1
    stopping: Stopping = field(default_factory=Stopping)

    fits_parameters: ClassVar[bool] = True

    def fit(self, problem: FitProblem, progress: Progress) -> FitResult:
        """Fit the problem; see :class:`trms_cli.identification.problem.Method`."""
        if not callable(getattr(self.training, "minimise", None)):
            raise ConfigurationError(
                f"{type(self.training).__name__} is no training algorithm",
                where="method.training",
                remedy="choose one of `trms list training`: training@method.training=lm",
            )
        _white_box(problem.model)
        bare = replace(
            problem, model=changed_beneath(problem.model, lambda m: m.with_network(None))
        )
        plain = self.parameters.fit(bare, _Part(progress, _SHARE_OF_PARAMETERS))
        if plain.outcome in (FitOutcome.FAILED, FitOutcome.INTERRUPTED):
            return replace(plain, method="torque_network")
        model = with_values(bare.model, plain.values)
        network = self._untrained(replace(bare, model=model, free=()))
        fitted = replace(bare, model=model)
        training, objective, samples = self._trained(fitted, plain, network, progress)
        begin, calls = plain.seconds, plain.evaluations
        losses = training.history.losses
        record = self._record(fitted, training, objective)
        result = replace(
            plain,
            method="torque_network",
            outcome=OUTCOMES[training.outcome],
            cost=float(losses[training.best_epoch if record["kept"] else 0]),
            history=[
                HistoryPoint(calls + i + 1, begin + second, loss)
                for i, (second, loss) in enumerate(
                    zip(training.history.seconds, losses, strict=True)
                )
            ],
            evaluations=calls + len(losses),
            seconds=begin + float(training.history.seconds[-1]),
            details=dict(plain.details) | {"network": record},
        )
        if not record["kept"]:
            return replace(
                result, remodel=lambda m: changed_beneath(m, lambda white: white.with_network(None))
            )
        mlp = _mlp(network)
        theta, scales = objective.values(training.theta)
        moved = len(theta) - mlp.n_parameters
        weights = mlp.weights(theta[moved:])
        if moved:
            of_z = objective.covariance(training.theta, samples)[:moved, :moved]
            covariance = of_z * np.outer(scales[:moved], scales[:moved])
            values = dict(zip(problem.names, theta[:moved].tolist(), strict=True))
            result = replace(result, values=values, covariance=covariance)
        told = {key: value for key, value in record.items() if key != "free_runs_without"}
        trained = replace(network, network=replace(network.network, weights=weights), training=told)
        return replace(
            result, remodel=lambda m: changed_beneath(m, lambda white: white.with_network(trained))
        )

    def _untrained(self, problem: FitProblem) -> TorqueNetwork:
        """The network with its scales, from the plain fit's own motion over the recordings."""
        white = _white_box(problem.model)
        regressors = self.regressors or white.regressor_names()
        torques = tuple(axis.moment for axis in white.axes.values())
        values, accelerations = _motion(problem)
        for name in regressors:
            if name not in values:
                raise ConfigurationError(
                    f"there is no {name!r} in this model",
                    where="method.regressors",
                    remedy=f"some of {', '.join(white.regressor_names())}",
                )
        point = white.symbols()
        quantities = white.quantities(*point[:3])
        still = (white.rest(), np.zeros(white.n_u), white.parameters.values)
        inertia = {
            axis.moment: float(
                ca.Function("inertia", list(point[:3]), [quantities[f"inertia_{name}"]])(*still)
            )
            for name, axis in white.axes.items()
        }
        angle_of = {axis.moment: axis.angle for axis in white.axes.values()}
        mlp = Mlp(len(regressors), len(torques), self.hidden)
        random = np.random.default_rng(np.random.SeedSequence([problem.seed, 0x544F5251]))
        weights = mlp.weights(mlp.start(random))
        last = len(self.hidden) + 1
        for name in (f"W{last}", f"b{last}"):
            weights[name][...] = 0.0
        spread = np.array([values[name].std() for name in regressors])
        network = Network(
            "mlp",
            weights,
            np.array([values[name].mean() for name in regressors]),
            np.where(spread > 0, spread, 1.0),
            np.zeros(len(torques)),
            np.array([_TORQUE_SHARE * inertia[t] * accelerations[angle_of[t]] for t in torques]),
        )
        return TorqueNetwork(regressors, torques, network)

    def _trained(
        self, problem: FitProblem, plain: FitResult, network: TorqueNetwork, progress: Progress
    ) -> tuple[Training, ShootingError, float]:
        """The training, its objective, and how many samples say as much as one."""
        model = changed_beneath(
            problem.model, lambda white: white.with_network(network, free_weights=True)
        )
        weights = tuple(_weight(name) for name in weight_names(network.network))
        free = (*(problem.free if self.joint else ()), *weights)
        weighed = replace(problem, model=model, free=free)
        samples = _samples_per_independent_one(plain)
        has_prior = np.array([parameter.prior_sd is not None for parameter in free], dtype=float)
        has_prior[len(free) - len(weights) :] = self.weight_decay
        residuals = sum(int(np.isfinite(d.measurements).sum()) for d in problem.datasets)
        prior = has_prior * samples / residuals
        if self.training.regularised:
            prior = np.zeros(len(free))
        values = [plain.values[parameter.name] for parameter in free[: -len(weights)]]
        values += [w for array in network.network.weights.values() for w in array.ravel()]
        start = (np.array(values) - weighed.prior_means) / weighed.scales
        objective = ShootingError(weighed, start, prior=prior)
        checked = None
        if problem.validation:
            held_out = replace(weighed, datasets=problem.validation, validation=())
            checked = ShootingError(held_out, start, sd=objective.sd, like=objective)
        watcher = training_watcher(
            progress,
            _SHARE_OF_PARAMETERS,
            1.0 - _SHARE_OF_PARAMETERS,
            self.stopping,
            "network, in units of the plain fit's error",
        )
        training = train(
            self.training, objective, start, self.stopping, validation=checked, watcher=watcher
        )
        return training, objective, samples

    def _record(
        self, problem: FitProblem, training: Training, objective: ShootingError
    ) -> dict[str, Any]:
        losses, checks = training.history.losses, training.history.validation
        kept = training.best_epoch
        enough = checks[kept] <= (1.0 - self.least_gain) * checks[0]
        return {
            "kept": kept > 0 and (bool(enough) or not problem.validation),
            "free_numbers": int(training.theta.size),
            "outcome": training.outcome.value,
            "epochs": training.history.epochs,
            "kept_epoch": kept,
            "loss": [float(losses[0]), float(losses[kept])],
            "validation_loss": [
                float(value) if np.isfinite(value) else None for value in (checks[0], checks[kept])
            ],
            "residual_sd": dict(
                zip(names(problem.model.outputs), objective.sd.tolist(), strict=True)
            ),
            "free_runs_without": {
                part: error_figures(runs)
                for part, runs in (
                    (part, window_runs(problem.model, data, problem.window_length))
                    for part, data in (("fit", problem.datasets), ("held_out", problem.validation))
                )
                if runs
            },
        }


def _weight(name: str) -> FreeParameter:
    """A weight as a free parameter: about zero, of the size one."""
    return FreeParameter(
        name=name,
        unit="1",
        start=0.0,
        prior_mean=0.0,
        prior_sd=1.0,
        lower=-np.inf,
        upper=np.inf,
    )


def _samples_per_independent_one(plain: FitResult) -> float:
    """The median over the outputs, as the plain fit estimated it."""
    outputs = plain.details.get("outputs") or {}
    values = [entry["samples_per_independent_one"] for entry in outputs.values()]
    return float(np.median(values)) if values else 1.0


class _Part:
    """The first part of a fit's progress."""

    def __init__(self, progress: Progress, share: float) -> None:
        self._progress, self._share = progress, share
        self.save, self.saved = progress.save, progress.saved

    def update(self, fraction: float, cost: float, message: str) -> bool:
        return self._progress.update(self._share * fraction, cost, f"parameters: {message}")


def changed_beneath(
    model: Model, change: Callable[[NewtonianWithNetwork], NewtonianWithNetwork]
) -> Model:
    """A model with its effects and prescribed states, and the white box beneath them changed."""
    if isinstance(model, NewtonianWithNetwork):
        return change(model)
    values = dict(zip(model.parameters.names, model.parameters.values.tolist(), strict=True))
    if isinstance(model, DrivenModel):
        return DrivenModel(changed_beneath(model.base, change), model.driven_states)
    if isinstance(model, ExtendedModel):
        base = changed_beneath(model.base, change)
        extended = ExtendedModel(base, model.effect_name, model.effect)
        return with_values(extended, values)
    raise _no_white_box(model)


def _white_box(model: Model) -> NewtonianWithNetwork:
    while isinstance(model, DrivenModel | ExtendedModel):
        model = model.base
    if not isinstance(model, NewtonianWithNetwork):
        raise _no_white_box(model)
    return model


def _no_white_box(model: Model) -> ConfigurationError:
    return ConfigurationError(
        f"model {model.name!r} has no place for a network",
        where="model",
        remedy=f"model={NewtonianWithNetwork.OPTION}",
    )


def _mlp(network: TorqueNetwork) -> Mlp:
    weights = network.network.weights
    hidden = tuple(len(weights[f"b{i}"]) for i in range(1, network.network.n_layers))
    return Mlp(len(network.regressors), len(network.torques), hidden)


def _motion(problem: FitProblem) -> tuple[dict[str, FloatArray], dict[str, float]]:
    """What the model does over the recordings' windows.

    Returns values by name (outputs, inputs, rates of the angles; (N,) arrays), and the spread of
    each angle's acceleration, rad/s².
    """
    windows = Windows(problem, with_parameters=False)
    model = problem.model
    p = model.parameters.values
    full = windows.with_memory(p, windows.starts(p))
    commands = np.vstack([dataset.commands for dataset in problem.datasets])
    with np.errstate(all="ignore"):
        y = windows.rollout.outputs(commands, windows.first, windows.count, full, p).y
    y = np.where(np.isfinite(y), y, 0.0)
    values = {name: y[:, i] for i, name in enumerate(names(model.outputs))}
    held = np.vstack([c[:n] for c, n in zip(windows.commands, windows.count, strict=True)])
    values |= {name: held[:, i] for i, name in enumerate(names(model.inputs))}
    accelerations = {}
    for name in _white_box(model).controlled:
        rates = np.concatenate(list(_rates(values[name], windows)))
        values[f"{name}_rate"] = rates
        accelerations[name] = float(np.concatenate(list(_rates(rates, windows))).std() or 1.0)
    return values, accelerations


def _rates(values: FloatArray, windows: Windows) -> Iterator[FloatArray]:
    """Derivative of (N,) values by time, window by window."""
    begin = 0
    for count in windows.count:
        yield np.gradient(values[begin : begin + count], windows.sample_time)
        begin += count
