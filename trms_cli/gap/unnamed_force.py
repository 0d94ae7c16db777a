"""Forces on an equation that no difference of a model makes: at random, or by a law without a name.

A torque from outside that varies is predicted by nothing but its own recent past: an
Ornstein–Uhlenbeck process of some deviation σ and correlation time τ, of which each window has the
mean. A law that nobody wrote down is a smooth function of one quantity of the rig (a state, a
command) or of the time: a sum of Gaussian radial basis functions with normal coefficients, coarse
or fine. Each is integrated over its sizes, so that what can be anything is not believed for that.
"""

import itertools
from dataclasses import replace

import numpy as np
from scipy.special import logsumexp

from trms_cli.core.arrays import FloatArray
from trms_cli.gap.evidence import ChangeEvidence, DifferenceScore

#: s. Correlation times of a torque from outside.
_TIMES = (0.3, 1.0, 3.0)
#: Deviations of a force, from what an equation errs by in any second to what acts there.
_SIZES = 5
#: Basis functions over the range of a quantity, and s between those over the time.
_COARSE, _FINE, _APART = 6, 18, 8.0


def law_evidence(evidence: ChangeEvidence) -> FloatArray:
    """Log evidence of a law without a name on each equation alone, (e,) nats."""
    evidences, bases = [], _bases(evidence)
    for e, rows in enumerate(evidence.rows):
        values = [
            evidence.with_columns(e, basis[rows], size)
            for basis, size in itertools.product(bases, _sizes(evidence, e))
        ]
        # of a single window nothing can be a law
        log_evidence = logsumexp(values) - np.log(len(values)) if values else evidence.unchanged
        evidences.append(log_evidence)
    return np.array(evidences)


def with_random_torque(evidence: ChangeEvidence, score: DifferenceScore) -> DifferenceScore:
    """A constant torque's score with that of one that varies at random, each with half the belief.

    The other ones come back as they are.
    """
    if score.difference.kind != "torque":
        return score
    locations = [equation.location for equation in evidence.runs.equations]
    e = locations.index(score.difference.locations[0])
    own = evidence.own[e]
    apart = np.where(
        own.recording[:, None] == own.recording, np.abs(own.time[:, None] - own.time), np.inf
    )
    trials = list(itertools.product(_sizes(evidence, e), _TIMES))
    length = evidence.runs.length
    logs = [
        evidence.with_covariance(
            e, size**2 * _window_mean_covariance(apart / length, time / length)
        )
        for size, time in trials
    ]
    varying = float(logsumexp(logs) - np.log(len(logs)))
    half = np.log(0.5)
    always = float(np.logaddexp(score.always, varying) + half)
    mixture = replace(score, always=always, begins=score.begins + half)
    if varying <= score.evidence:
        return mixture
    weights = np.exp(np.array(logs) - max(logs))
    sizes = np.array([size for size, _ in trials])
    mean = float(weights @ sizes / weights.sum())
    spread = float(np.sqrt(weights @ (sizes - mean) ** 2 / weights.sum()))
    # nothing foretells it, so that nothing is drawn beside the force that is missing
    difference = replace(score.difference, labels=("deviation",))
    return replace(
        mixture,
        difference=difference,
        value=np.array([mean]),
        sd=np.array([spread]),
        onset=None,
        change=np.zeros_like(score.change),
        varies=True,
    )


def _sizes(evidence: ChangeEvidence, e: int) -> FloatArray:
    error = evidence.known_state.errors[e]
    least = min(float(error.sizes.white), 0.3 * error.scale)
    return np.geomspace(least, error.scale, _SIZES)


def _window_mean_covariance(apart: FloatArray, time: float) -> FloatArray:
    """Covariance of means over windows of unit length, of a process of unit variance.

    ``apart``: (m, m) array; between the beginnings of windows, in lengths. ``time``: the same unit.
    """
    decay = 1 - np.exp(-1 / time)
    near = 2 * time * (1 - time * decay)
    far = time**2 * decay**2 * np.exp((1 - np.maximum(apart, 1.0)) / time)
    return np.where(apart < 0.5, near, far)


def _bases(evidence: ChangeEvidence) -> list[FloatArray]:
    """Radial basis functions of each quantity, (m, k) arrays."""
    runs, starts = evidence.runs, evidence.questioned.starts
    commands = runs.windows.commands.mean(axis=1)
    bases = []
    for values in (*starts.T, *commands.T):
        low, high = np.quantile(values, [0.02, 0.98])
        if not high > low:
            continue
        bases += [_radial_basis(values, low, high, count) for count in (_COARSE, _FINE)]
    if len(runs) > 1:
        order = np.arange(len(runs), dtype=float)
        count = max(3, round(len(runs) * runs.length / _APART))
        bases.append(_radial_basis(order, 0.0, order[-1], count))
    return bases


def _radial_basis(values: FloatArray, low: float, high: float, count: int) -> FloatArray:
    centres = np.linspace(low, high, count)
    width = (high - low) / (count - 1)
    return np.exp(-0.5 * ((np.clip(values, low, high)[:, None] - centres) / width) ** 2)
