"""Which parameters of the nominal model differ on the rig, alone, and what that is in its parts.

A refit moves all parameters at once, each a little, and so names none. Here each either keeps to
what was known of it, or has moved (spike and slab: George & McCulloch, J. Am. Stat. Assoc. 88,
1993): with z the change of a parameter in standard deviations of its prior,

    z ~ N(0, _STAYED²) or N(0, _MOVED²)

and the likelihood is the parabola that the refit's optimum has, of which the prior is taken out
again. A Gibbs sampler goes over what has moved; the probability of a parameter is the mean of its
conditional ones.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from trms_cli.core.arrays import BoolArray, FloatArray
from trms_cli.core.wording import number, unit
from trms_cli.effects.model_form import MODEL_FORM
from trms_cli.gap.competing_model import FittedModel
from trms_cli.gap.diagnosis import MovedParameter
from trms_cli.models.model import Model
from trms_cli.models.parameters import Parameter
from trms_cli.models.rig_parts import parts_of

#: Probability of other parameters from which it is told which.
WORTH_TELLING = 0.05
#: Prior standard deviations by which parameters that have not moved, and those that have, stray.
_STAYED, _MOVED = 0.25, 2.5
#: Probability of each to have moved, before the recordings.
_BEFORE = 0.1
#: Of the sampler: sweeps that are not counted, and those that are.
_UNCOUNTED, _SWEEPS = 60, 400
#: Probability below which a parameter is not listed: the recordings do not speak for its move.
_LEAST = 0.15
#: Share of the gravity moment from which its change is told, and kg below which no mass is.
_LEAST_SHARE, _LEAST_MASS = 0.005, 1e-4
#: m/s², where a model has none of its own.
_GRAVITY = 9.81


@dataclass(frozen=True)
class Moves:
    """What is believed of the parameters' changes, in standard deviations of their priors."""

    probability: FloatArray  #: (k,) array; that each has moved
    mean: FloatArray  #: (k,) array; of its change, if it has
    sd: FloatArray  #: (k,) array; the same


def moved_parameters(
    refit: FittedModel, model: Model, tilt: float, seed: int = 0
) -> tuple[MovedParameter, ...]:
    """The parameters that may differ, the likeliest first.

    ``refit``: without any effect. ``model``: the nominal one, whose values stand in the words.
    ``tilt``: rad, of a beam in the recordings' mean; changes of gravity are told there.
    """
    fit, free = refit.fit, refit.structure.problem.free
    if fit.evidence is None or not free:
        return ()
    scales = np.array([p.scale for p in free])
    has_prior = np.array([p.prior_sd is not None for p in free])
    n = len(free)  # behind them stand the drives' gains
    covariance = fit.evidence.covariance[:n, :n] / np.outer(scales, scales)
    # one that lies on a bound has no spread, and takes no part
    inside = np.flatnonzero(np.isfinite(np.diag(covariance)) & (np.diag(covariance) > 0))
    if not len(inside):
        return ()
    z = (fit.theta - np.array([p.prior_mean for p in free])) / scales
    moves = sampled_moves(z[inside], covariance[np.ix_(inside, inside)], has_prior[inside], seed)
    parameters = []
    for k, i in enumerate(inside):
        if moves.probability[k] < _LEAST or free[i].name.split(".")[0] in MODEL_FORM:
            continue
        parameter = model.parameters[free[i].name]
        # the parabola knows no bounds
        value = parameter.value + float(moves.mean[k] * scales[i])
        change = float(np.clip(value, free[i].lower, free[i].upper)) - parameter.value
        probability, sd = float(moves.probability[k]), float(moves.sd[k] * scales[i])
        parameters.append(moved_parameter(model, parameter, probability, change, sd, tilt))
    return tuple(sorted(parameters, key=lambda item: -item.probability))


def moved_parameter(
    model: Model, parameter: Parameter, probability: float, change: float, sd: float, tilt: float
) -> MovedParameter:
    """A parameter that may have moved, with its change (in its unit) in words."""
    return MovedParameter(
        parameter=parameter.name,
        probability=probability,
        change=change,
        sd=sd,
        unit=parameter.unit,
        words=change_in_words(model, parameter, change, tilt, sd),
    )


def sampled_moves(
    z: FloatArray, covariance: FloatArray, has_prior: BoolArray, seed: int = 0
) -> Moves:
    """Spike and slab over a Gaussian posterior.

    ``z``, (k,) array: its mean, in standard deviations of the priors. ``covariance``, (k, k) array.
    ``has_prior``, (k,) array: whose priors are in it, to be taken out.
    """
    k = len(z)
    precision = np.linalg.inv(covariance)
    towards = precision @ z
    likelihood = precision - np.diag(has_prior.astype(float))
    values, vectors = np.linalg.eigh(0.5 * (likelihood + likelihood.T))
    likelihood = (vectors * np.maximum(values, 0.0)) @ vectors.T
    random = np.random.default_rng(np.random.SeedSequence([seed, 0x30CE]))
    spike_precision, slab_precision = _STAYED**-2, _MOVED**-2
    has_moved = np.zeros(k, dtype=bool)
    sums = np.zeros((4, k))
    for sweep in range(_UNCOUNTED + _SWEEPS):
        inverse = np.linalg.inv(
            likelihood + np.diag(np.where(has_moved, slab_precision, spike_precision))
        )
        for i in range(k):
            # both states of this one, from the inverse at hand (Sherman & Morrison)
            own, mean = inverse[i, i], float(inverse[i] @ towards)
            now = slab_precision if has_moved[i] else spike_precision
            odds, means, spreads = {}, {}, {}
            for name, prior in ((False, spike_precision), (True, slab_precision)):
                denominator = 1 + (prior - now) * own
                odds[name] = 0.5 * (np.log(prior) - np.log(denominator))
                odds[name] -= 0.5 * (prior - now) * mean**2 / denominator
                means[name], spreads[name] = mean / denominator, own / denominator
            logit = odds[True] - odds[False] + np.log(_BEFORE / (1 - _BEFORE))
            p = float(1 / (1 + np.exp(-np.clip(logit, -500, 500))))
            if sweep >= _UNCOUNTED:
                square = spreads[True] + means[True] ** 2
                sums[:, i] += (p, p * means[True], p * square, 1.0)
            draw = bool(random.uniform() < p)
            if draw != has_moved[i]:
                apart = (slab_precision if draw else spike_precision) - now
                column = inverse[:, i].copy()
                inverse -= apart / (1 + apart * own) * np.outer(column, column)
                has_moved[i] = draw
    weight = np.maximum(sums[0], 1e-300)
    mean = sums[1] / weight
    return Moves(sums[0] / sums[3], mean, np.sqrt(np.maximum(sums[2] / weight - mean**2, 0.0)))


def change_in_words(
    model: Model, parameter: Parameter, change: float, tilt: float, sd: float = 0.0
) -> str:
    """A change as a colleague calls it, with what it does to gravity where it does.

    ``sd``: standard deviation of the change, told where it is above zero.
    """
    what = parameter.description or parameter.name
    value, unit_text = parameter.value, unit(parameter.unit)
    error = f" ± {number(float(sd), 2)}" if sd > 0 else ""
    spread = f"{number(value)} → {number(value + change)}{error} {unit_text}".rstrip()
    own = (
        f"{what} {spread}" if value == 0 else f"{what} {signed_percent(change / value)} ({spread})"
    )
    gravity = gravity_in_words(model, {parameter.name: value + change}, tilt)
    return f"{gravity}: {own}" if gravity else own


def gravity_in_words(model: Model, values: Mapping[str, float], tilt: float) -> str:
    """The gravity moment under other parameters: ``… −9 %, as 14 g at the nose would``.

    Empty where the model has no beam, or it hardly changes. The nose is where the rotor that raises
    it is; a mass there moves the beam as the change does at the given tilt, and elsewhere
    differently.
    """
    parts = parts_of(model)
    nose = f"arm_{parts.drive_of(parts.beam)}"
    x, u, p, _ = model.symbols()
    quantities = model.quantities(x, u, p)
    if not parts.beam or nose not in quantities:
        return ""
    outputs = [quantities["gravity_moment"], quantities[nose]]
    at = ca.Function("gravity", [x, u, p], outputs)
    before = model.parameters.values
    after = model.parameters.replaced(values).values

    def moment(angle: float, of: FloatArray) -> FloatArray:
        state = model.rest()
        state[model.state_index(parts.axes[parts.beam].angle)] = angle
        return np.array([float(v) for v in at(state, np.zeros(model.n_u), of)])

    whole = [np.hypot(moment(0, of)[0], moment(np.pi / 2, of)[0]) for of in (before, after)]
    if not whole[0] > 0 or not np.isfinite(whole).all():
        return ""
    share = whole[1] / whole[0] - 1
    (old, arm), (new, _) = moment(tilt, before), moment(tilt, after)
    parameters = model.parameters
    g = parameters["g"].value if "g" in parameters else _GRAVITY
    mass = -(new - old) / (g * arm * np.cos(tilt)) if arm > 0 and np.cos(tilt) > 0.1 else 0.0
    if abs(share) < _LEAST_SHARE:
        return ""
    text = f"gravity moment of the beam {signed_percent(share)}"
    if abs(mass) < _LEAST_MASS:
        return text
    grams = f"{number(1e3 * abs(mass), 2)} g{'' if mass > 0 else ' less'}"
    return f"{text}, as {grams} at the nose would"


def signed_percent(share: float) -> str:
    """A change in per cent with its sign, to two digits: ``−9 %``, ``+0.8 %``."""
    text = number(abs(100 * share), 2)
    return f"{'−' if share < 0 else '+'}{text} %"
