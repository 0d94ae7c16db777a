"""Fits of many rigs, and how often the truth lies inside the intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from experiments.coverage.rigs import record_rig
from trms_cli.identification.multiple_shooting import MultipleShooting
from trms_cli.identification.problem import FitProblem, SilentProgress, free_parameters
from trms_cli.models.newtonian import Newtonian

FloatArray = npt.NDArray[np.float64]

#: Two-sided 95 % quantile of the normal distribution.
_QUANTILE = 1.959963984540054
#: Parameters that such recordings determine by themselves when the others are known.
IDENTIFIABLE = (
    "k_fvp", "k_fhp", "k_fhn", "k_g", "k_m", "k_t", "k_oh", "k_ov", "k_chp", "k_chn",
)  # fmt: skip
#: Share of an angle's range beyond which a stop was hit: it holds the beam a hair inside.
STOPPED = 0.995
#: A parameter has learnt from the data when its deviation fell below this share of the prior's.
LEARNT = 0.9


@dataclass(frozen=True)
class Coverage:
    """Errors of fits over their reported standard deviations."""

    names: tuple[str, ...]
    errors: FloatArray  #: (rigs, n_f) array; estimate less truth, in reported standard deviations
    remaining: FloatArray  #: (rigs, n_f) array; reported deviation over the prior's
    seconds: FloatArray  #: (rigs,) array; of each fit
    unsettled: int  #: Fits that did not say that they converged; they are counted all the same
    left_out: int  #: Rigs that hit a mechanical stop, which the fitted model does not have

    @property
    def inside(self) -> FloatArray:
        """Share of the rigs whose truth lies inside the 95 % interval, by parameter."""
        inside: FloatArray = (np.abs(self.errors) < _QUANTILE).mean(axis=0)
        return inside

    @property
    def overall(self) -> tuple[float, float]:
        """Share over all parameters, and its standard error.

        Errors of one fit hang together, so that the rigs are what is counted.
        """
        return self._share(np.ones_like(self.errors, dtype=bool))

    @property
    def of_learnt(self) -> tuple[float, float]:
        """The same over those parameters that the data told something about."""
        return self._share(self.remaining < LEARNT)

    def _share(self, counted: npt.NDArray[np.bool_]) -> tuple[float, float]:
        hits = ((np.abs(self.errors) < _QUANTILE) & counted).sum(axis=1)
        some = counted.sum(axis=1) > 0
        shares = hits[some] / counted.sum(axis=1)[some]
        return float(shares.mean()), float(shares.std(ddof=1) / np.sqrt(len(shares)))


def coverage(
    seeds: Sequence[int],
    *,
    duration: float = 60.0,
    with_priors: bool = True,
    jobs: int = 1,
    told: Callable[[int], None] = lambda count: None,
) -> Coverage:
    """Fit one rig a seed.

    Parameters
    ----------
    duration : float
        Of each recording, s, at 50 Hz.
    with_priors : bool
        All parameters with priors are free, and the rigs are drawn from these priors; or else
        :data:`IDENTIFIABLE` are free without any prior and the others are known.
    jobs : int
        Threads of each fit.
    told : callable
        Called with the number of rigs done.
    """
    errors, remaining, seconds, unsettled, left_out = [], [], [], 0, 0
    names: tuple[str, ...] = ()
    for count, seed in enumerate(seeds):
        told(count)
        model = Newtonian()
        nominal = model.parameters
        record = record_rig(model, seed, duration)
        if record.travel > STOPPED:
            left_out += 1
            continue
        if with_priors:
            free = free_parameters(nominal, ["priors"])
        else:
            start = {name: nominal[name].value for name in IDENTIFIABLE}
            model.parameters = record.truth.replaced(start)
            free = free_parameters(
                model.parameters, IDENTIFIABLE, priors=dict.fromkeys(IDENTIFIABLE)
            )
        problem = FitProblem(model=model, datasets=(record.dataset,), free=free, jobs=jobs)
        result = MultipleShooting(starts=1).fit(problem, SilentProgress())
        assert result.covariance is not None
        names = problem.names
        truth = np.array([record.truth[name].value for name in names])
        sd = np.sqrt(np.diag(result.covariance))
        errors.append((result.theta - truth) / sd)
        before = np.array([nominal[n].value * (nominal[n].prior_sd or np.inf) for n in names])
        remaining.append(sd / before)
        seconds.append(result.seconds)
        unsettled += not result.outcome.settled
    return Coverage(
        names, np.array(errors), np.array(remaining), np.array(seconds), unsettled, left_out
    )
