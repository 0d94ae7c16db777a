"""filterpy's unscented Kalman filter: a second opinion beside :mod:`trms_cli.observers.ukf`.

The model, its augmentation, the sigma points' settings, gate and recovery are the same; prediction
and update are :class:`filterpy.kalman.UnscentedKalmanFilter`'s own, in Python. It updates the
covariance as P − K S Kᵀ; the least variances are added as ours adds them.

filterpy knows no missing channel and no gate: which channels it is given at a sample is decided
here, from the same sigma points, before its update. The sigma points are drawn anew between
prediction and update, which filterpy itself does from version 2 on.
"""

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.process_cache import call_memoised
from trms_cli.core.ranges import NotNegative
from trms_cli.observers.augmentation import Augmentation
from trms_cli.observers.observer import ObserverSetup
from trms_cli.observers.recursive_filter import FilterStep, GatedFilter
from trms_cli.observers.ukf import (
    SigmaPoints,
    dynamics_stage,
    friction_stage,
    measurement_stage,
    step_stage,
)


@dataclass(frozen=True, kw_only=True)
class FilterpyUkf(GatedFilter):
    """filterpy's unscented Kalman filter; the fields that it shares with the others are those of
    :class:`trms_cli.observers.augmentation.FilterOptions`.
    """

    #: ``alpha``, ``beta``, ``kappa``: Spread of the sigma points; see :class:`SigmaPoints`
    alpha: Annotated[float, Meta(gt=0, le=1)] = 1.0
    beta: NotNegative = 2.0
    kappa: float = 0.0

    def bind(self, setup: ObserverSetup, augmented: Augmentation) -> tuple[FilterStep, FloatArray]:
        """A step through filterpy; see :class:`trms_cli.observers.recursive_filter.GatedFilter`."""
        points = SigmaPoints(augmented.n, self.alpha, self.beta, self.kappa)
        parameters = augmented.model.parameters.values
        return _FilterpyStep(augmented, points, setup.sample_time), parameters


class _FilterpyStep:
    """One sample; see :mod:`trms_cli.observers.recursive_filter` for inputs and outputs."""

    def __init__(self, augmented: Augmentation, points: SigmaPoints, sample_time: float) -> None:
        # imported where it is used: that takes longer than a short run
        from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

        model, n, n_y = augmented.model, augmented.n, len(augmented.channels)
        n_m, n_u, n_w, n_p = augmented.n_m, model.n_u, model.n_w, len(model.parameters)
        sizes: list[Any] = [n, (n, n), n_m, n_u, n_y, n_y, 1, n_w, n_p, n, n_y, n, n_y]
        self.inputs: tuple[FloatArray, ...] = tuple(np.zeros(size) for size in sizes)
        sizes = [n, (n, n), n_m, 1, n, n_w, n_w, n_y, n_y, n_y, n_y]
        self.outputs: tuple[FloatArray, ...] = tuple(np.zeros(size) for size in sizes)
        alone = augmented.alone()
        gliding, observable = alone.gliding(), alone.observable()
        #: What dry friction adds, linearised at the mean, as the ukf has it; None without any.
        self._friction: BufferedFunction | None = None
        if gliding is None or observable is None:
            self._advance = BufferedFunction(call_memoised(dynamics_stage, alone))
        else:
            self._advance = BufferedFunction(step_stage(alone, gliding.step))
            self._friction = BufferedFunction(friction_stage(alone, gliding))
            self._observable = BufferedFunction(observable)
        self._mean = np.zeros(n)
        self._measure = BufferedFunction(call_memoised(measurement_stage, augmented.alone()))
        self._points = MerweScaledSigmaPoints(n, points.alpha, points.beta, points.kappa)
        self._filter = UnscentedKalmanFilter(
            n, n_y, sample_time, self._measured, self._transition, self._points
        )
        self._n, self._n_s, self._equations = n, augmented.n_s, augmented.equations

    def __call__(self) -> None:
        try:
            with np.errstate(all="ignore"):  # what overflows is not healthy
                self._step()
        except (np.linalg.LinAlgError, ValueError):  # no root of a covariance: the filter recovers
            self.outputs[3][0] = np.nan

    def _step(self) -> None:
        m, P, memory, u, y, mask, advance, w_known, p, q, r, floor, gate = self.inputs
        for function, values in ((self._advance, (memory, u, p, w_known)), (self._measure, (u, p))):
            for argument, value in zip(function.inputs[1:], values, strict=True):
                argument[:] = value
        if self._friction is not None:
            self._mean[:] = m
            self._friction.evaluate(m, memory, u, p, w_known)
            q = q * self._observable.evaluate(m, memory, u, p, w_known)[0]
        peer = self._filter
        peer.x, peer.P, peer.Q = m.copy(), P.copy(), np.diag(q)
        memory_next = memory.copy()
        if advance[0] > 0:
            peer.predict()
            memory_next[:] = self._advance.outputs[0][self._n :]
        peer.sigmas_f = self._points.sigma_points(peer.x, peer.P)

        sensed = np.array([self._measured(point) for point in peer.sigmas_f])
        predicted = peer.Wm @ sensed
        variance = peer.Wc @ (sensed - predicted) ** 2 + r
        innovation = mask * (y - predicted)
        accepted = (mask > 0) & (innovation**2 <= gate * variance)
        if accepted.any():
            peer.update(
                y[accepted],
                R=np.diag(r[accepted]),
                hx=lambda point: self._measured(point)[accepted],
            )
        covariance = 0.5 * (peer.P + peer.P.T) + np.diag(floor)
        sd = np.sqrt(np.diag(covariance))
        disturbance, disturbance_sd = w_known.copy(), np.zeros_like(w_known)
        for k, equation in enumerate(self._equations):
            disturbance[equation] += peer.x[self._n_s + k]
            disturbance_sd[equation] = sd[self._n_s + k]
        results = (
            *(peer.x, covariance, memory_next, peer.x.sum() + sd.sum() + covariance.sum(), sd),
            *(disturbance, disturbance_sd, predicted, innovation, np.sqrt(variance)),
            mask - accepted,
        )
        for output, result in zip(self.outputs, results, strict=True):
            output[...] = result

    def _transition(self, point: FloatArray, _: float) -> FloatArray:
        self._advance.inputs[0][:] = point
        self._advance()
        after = self._advance.outputs[0][: self._n].copy()
        if self._friction is not None:
            added, slope = self._friction.outputs
            after += added + slope @ (point - self._mean)
        return after

    def _measured(self, point: FloatArray) -> FloatArray:
        self._measure.inputs[0][:] = point
        self._measure()
        return self._measure.outputs[0].copy()
