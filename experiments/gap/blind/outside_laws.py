"""What a rig can have and no library has: the laws of the effects outside.

Each is what benches do: play between wheels, an encoder that hangs, a base that is not level, a
propeller that stalls on the way up and not on the way down. Sizes by name and what is typical are
in :mod:`.truths`; the ones that need no memory of their own and are older stand in :mod:`.rig`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from experiments.gap.blind.parts import Bristles, Play

FloatArray = npt.NDArray[np.float64]
Size = Callable[[str, str], FloatArray]

_LIMIT = 2.5  # V, of a drive that does not saturate early
#: rad/s by which a rotor's speed has to turn back until its flow has settled the other way.
_FLOW = {"main": 30.0, "tail": 40.0}
#: rad. Middle and half width of the band in which a soft stop of pitch is not felt; place and
#: width of a detent.
_BAND_MIDDLE, _BAND = -0.15, 0.12
_DETENT, _DETENT_WIDTH = -0.1, 0.05
#: s. Time constants of what ages or warms.
_AGEING, _WARMING = 60.0, 100.0
_HANGS_EVERY = 3.0  # s, on average


class OutsideLaws:
    """Their state for n rigs.

    Parameters
    ----------
    size : callable
        ``size(effect, name)`` gives the sizes of all rigs, (n,); zero where there is none.
    n : int
    step : float
        s, of the integration.
    """

    def __init__(self, size: Size, n: int, step: float) -> None:
        self._size, self._step = size, step
        self._rub = Bristles(np.full(n, 0.05), 2e-4)
        self._drive = {rotor: Play() for rotor in _FLOW}
        self._flow = {rotor: Play() for rotor in _FLOW}
        self._fullness = {rotor: np.zeros(n) for rotor in _FLOW}
        self._wheel = {axis: Play() for axis in ("pitch", "yaw")}
        self._loose = dict.fromkeys(self._wheel, np.zeros(n))
        self._thrust = np.zeros(n)
        self._hangs = np.zeros(n)
        self._last_angles: FloatArray | None = None

    def _has(self, effect: str, name: str) -> FloatArray | None:
        values = self._size(effect, name)
        return values if values.any() else None

    def drive_voltage(self, rotor: str, u: FloatArray) -> FloatArray:
        """What a drive makes of its command, V."""
        width = self._has(f"{rotor}_drive_backlash", "width")
        if width is not None:
            u = self._drive[rotor].follow(u, width)
        cut = self._has(f"{rotor}_early_limit", "cut")
        if cut is not None:
            u = np.clip(u, -_LIMIT / (1 + cut), _LIMIT / (1 + cut))
        return u

    def thrusts(
        self, main: FloatArray, tail: FloatArray, tail_speed: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Both thrusts, N."""
        share = self._has("main_thrust_hysteresis", "share")
        if share is not None:
            main = main * (1 + share * self._fullness["main"])
        share = self._has("tail_thrust_hysteresis", "share")
        if share is not None:
            tail = tail * (1 + share * self._fullness["tail"])
        share = self._has("tail_wake_on_main", "share")
        if share is not None:
            main = main * (1 - share * (tail_speed / 300.0) ** 2)
        self._thrust = main
        return main, tail

    def torques(self, x: FloatArray, time: float) -> FloatArray:
        """Torques on pitch and yaw, (2, n) N m; ``x``: ω_m, ω_t, q, r, θ, ψ."""
        w_m, _, q, r, theta, psi = x
        pitch, yaw = np.zeros_like(q), np.zeros_like(r)
        torque = self._has("yaw_one_sided_friction", "torque")
        if torque is not None:
            self._rub.shape(torque, np.zeros_like(torque), np.ones_like(torque))
            yaw = yaw - self._rub.torque(r, self._step) / (1 + np.exp(-psi / 0.05))
        for rate, axis in ((q, "pitch"), (r, "yaw")):
            coefficient = self._has(f"{axis}_one_way_damping", "coefficient")
            if coefficient is not None:
                braked = coefficient * np.minimum(rate, 0)
                pitch, yaw = (pitch - braked, yaw) if axis == "pitch" else (pitch, yaw - braked)
        away = theta - _BAND_MIDDLE
        beyond = np.sign(away) * np.maximum(np.abs(away) - _BAND, 0)
        pitch = pitch - self._size("pitch_soft_stop", "stiffness") * beyond
        near = (theta - _DETENT) / _DETENT_WIDTH
        pitch = pitch - self._size("pitch_detent", "torque") * near * np.exp(0.5 - near**2 / 2)
        pitch = pitch + self._size("tilted_base", "torque") * np.sin(psi)
        yaw = yaw - self._size("yaw_downwash_damping", "coefficient") * np.abs(w_m) * r
        aged = 1 - np.exp(-time / _AGEING)
        yaw = yaw - self._size("yaw_ageing_stiffness", "stiffness") * aged * psi
        return np.stack([pitch, yaw])

    def advance(self, x: FloatArray) -> None:
        """Remember where rotors and axes have come to."""
        for i, rotor in enumerate(_FLOW):
            if self._has(f"{rotor}_thrust_hysteresis", "share") is not None:
                width = _FLOW[rotor]
                at = self._flow[rotor].follow(x[i], np.full_like(x[i], width))
                self._fullness[rotor] = (x[i] - at) / width
        for i, axis in enumerate(self._wheel):
            width_ = self._has(f"{axis}_encoder_backlash", "width")
            if width_ is not None:
                self._loose[axis] = self._wheel[axis].follow(x[4 + i], width_) - x[4 + i]

    def encoder_angle(self, axis: str, angle: FloatArray, x: FloatArray, time: float) -> FloatArray:
        """What an encoder makes of an angle, rad."""
        angle = angle + self._loose[axis]
        if axis == "pitch":
            warm = 1 - np.exp(-time / _WARMING)
            angle = angle + self._size("pitch_sensor_drift", "bias") * warm
            angle = angle + self._size("pitch_reads_yaw", "share") * x[5]
            return angle + self._size("pitch_beam_bending", "compliance") * self._thrust
        return angle + self._size("yaw_reads_pitch", "share") * x[4]

    def hold_last(
        self, angles: FloatArray, sample_time: float, random: np.random.Generator
    ) -> FloatArray:
        """Angles (n, 2) as they are handed on: an encoder that hangs tells its last one."""
        time = self._has("pitch_encoder_hangs", "time")
        if time is not None and self._last_angles is not None:
            lots = random.uniform(size=len(time))
            begins = (self._hangs <= 0) & (lots < sample_time / _HANGS_EVERY) & (time > 0)
            self._hangs = np.where(begins, time, self._hangs - sample_time)
            angles = angles.copy()
            angles[:, 0] = np.where(self._hangs > 0, self._last_angles[:, 0], angles[:, 0])
        self._last_angles = angles
        return angles
