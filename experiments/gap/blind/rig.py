"""Rigs of the blind benchmark: many at once, from code that shares nothing with the models.

The physics is that of the nominal Newtonian model, written in angular velocities instead of
momenta; with ``r`` the yaw rate, ``q`` the pitch rate, θ the pitch angle and Js for inertias

    ω̇ = (kφ i − B ω − k_t ω|ω|)/J            i = (k_u v − kφ ω)/R
    q̇ = (l_m F_m + k_g F_m r cos θ − k_ov q + g[(A − B) cos θ − C sin θ] − ½ H r² sin 2θ)/J_v
        + k_t ω̇_t/J_v
    ṙ = (l_t F_t cos θ − k_oh r − k_ch ψ)/J_h + d/dt(k_m ω_m cos θ/J_h)

Integrated by Heun's method in steps of 1 ms, with friction by bristles that bend before they slide
(LuGre: Canudas de Wit et al. 1995, IEEE Trans. Autom. Control 40), cable hysteresis by elastic
slips in parallel (Iwan 1966, J. Appl. Mech. 33), and nuisances that are always on: sampling
jitter, a drive gain that drifts by up to a few percent, a slight flexibility before the encoders.
Only the parameter values are the models': they are data.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np
import numpy.typing as npt

from experiments.gap.blind.parts import Bristles, DelayLine, Oscillator, Slips

FloatArray = npt.NDArray[np.float64]

STEP = 1e-3  #: s, of the integration
PITCH_QUANTUM = YAW_QUANTUM = 2 * np.pi / 4096  #: rad
SPEED_QUANTUM = 0.4917  #: rad/s
SPEED_NOISE = 1.6  #: rad/s
PITCH_STOP, YAW_STOP = 1.05, 2.8  #: rad
COMMAND_LIMIT = 2.5  #: V


class Driver(Protocol):
    """What commands the rigs."""

    def command(self, k: int, time: float, measured: FloatArray) -> FloatArray:
        """Commands (n, 2) of main and tail rotor from the sample on, V.

        Parameters
        ----------
        k : int
            Index of the sample.
        time : float
            s.
        measured : (n, 4) array
            α_v, α_h, ω_v, ω_h as the sensors give them.
        """


@dataclass(frozen=True)
class Nuisances:
    """What every rig has and nobody asks for."""

    #: float or (n,) array; s, standard deviation of the sampling instants
    jitter: float | FloatArray = 2e-4
    #: Share by which a drive's gain wanders over a recording, standard deviation
    drift: float = 0.01
    flexibility: float = 0.3  #: Share of the deflection of a stiff mode that the encoders see


@dataclass(frozen=True)
class RigRecordings:
    """What came out."""

    time: FloatArray  #: (k,) array; s
    commands: FloatArray  #: (n, k, 2) array; V, u_v and u_h
    measured: FloatArray  #: (n, k, 4) array; α_v, α_h [rad], ω_v, ω_h [rad/s]


@dataclass
class Rigs:
    """A number n of rigs that differ in parameters and effects."""

    #: dict of str to (n,) array; the parameters by the names of the set ``bench``
    constants: Mapping[str, FloatArray]
    #: dict of str to (n,) array; sizes of effects, ``<effect>.<size>``; what is not named is zero
    sizes: Mapping[str, FloatArray] = field(default_factory=dict)
    nuisances: Nuisances = field(default_factory=Nuisances)
    seed: int = 0

    def __len__(self) -> int:
        return len(self.constants["g"])

    def size(self, effect: str, name: str) -> FloatArray:
        """A size of an effect for every rig, (n,)."""
        return self.sizes.get(f"{effect}.{name}", self._none)

    @cached_property
    def _none(self) -> FloatArray:
        return np.zeros(len(self))

    def run(
        self, driver: Driver, duration: float, sample_time: float, settling: float = 20.0
    ) -> RigRecordings:
        """Drive all rigs for a while.

        ``duration``, ``sample_time``: s; a sample is a whole number of integration steps.
        ``settling``: s at the first command before, with the axes braked, so that no run begins
        wild; with 0 a run begins hanging at rest.
        """
        run = _Run(self, sample_time)
        run.settle(driver, settling)
        samples = round(duration / sample_time)
        commands = np.empty((len(self), samples, 2))
        measured = np.empty((len(self), samples, 4))
        for k in range(samples):
            measured[:, k] = run.measure()
            command = driver.command(k, k * sample_time, measured[:, k])
            commands[:, k] = np.clip(command, -COMMAND_LIMIT, COMMAND_LIMIT)
            run.advance(commands[:, k])
        time: FloatArray = sample_time * np.arange(samples, dtype=float)
        return RigRecordings(time, commands, measured)


class _Run:
    """The state of all rigs during a run."""

    def __init__(self, rigs: Rigs, sample_time: float) -> None:
        self.rigs, self.c, size = rigs, rigs.constants, rigs.size
        n = len(rigs)
        self.random = np.random.default_rng(rigs.seed)
        self.steps = round(sample_time / STEP)
        self.time = 0.0
        self._geometry()
        # ω_m, ω_t, q, r, θ, ψ
        self.x = np.zeros((6, n))
        self.x[4] = -np.arctan2(self.B - self.A, self.C)
        self.x_before = self.x.copy()
        self.v = np.zeros((2, n))
        self.warmth, self.lagged = np.zeros((2, n)), np.zeros((2, n))
        self.drift = np.ones((2, n))
        self.drift_phase = self.random.uniform(0, 2 * np.pi, (2, n))
        self.drift_period = self.random.uniform(40.0, 200.0, (2, n))
        rotors, axes = ("main", "tail"), ("pitch", "yaw")
        self.delays = [DelayLine(size(f"{r}_input_delay", "delay"), 0.2, STEP) for r in rotors]
        self.friction = [
            Bristles(
                size(f"{a}_coulomb_friction", "torque") + size(f"{a}_stribeck_friction", "torque"),
                size(f"{a}_stribeck_friction", "excess"),
                np.maximum(size(f"{a}_stribeck_friction", "velocity"), 1e-3),
                inertia,
            )
            for a, inertia in zip(axes, (self.J_v, self.D + self.F), strict=True)
        ]
        self.cable = Slips(
            size("yaw_cable_hysteresis", "torque"), size("yaw_cable_hysteresis", "width")
        )
        self.push = np.zeros((2, n))
        share = np.full(n, rigs.nuisances.flexibility)
        self.modes = [Oscillator(share, np.full(n, 21.0), np.full(n, 0.03)) for _ in axes]
        self.flexible = [
            Oscillator(*(size(f"{a}_flexible_mode", s) for s in ("share", "frequency", "damping")))
            for a in axes
        ]
        self.late = [DelayLine(size(f"{a}_sensor_delay", "delay"), 0.2, STEP) for a in axes]
        self.tacho = np.zeros((2, n))

    def _geometry(self) -> None:
        c = self.c
        self.A = (c["m_t"] / 2 + c["m_tr"] + c["m_ts"]) * c["l_t"]
        self.B = (c["m_m"] / 2 + c["m_mr"] + c["m_ms"]) * c["l_m"]
        self.C = c["m_b"] * c["l_b"] / 2 + c["m_cb"] * c["l_cb"]
        main = c["m_m"] / 3 + c["m_mr"] + c["m_ms"]
        tail = c["m_t"] / 3 + c["m_tr"] + c["m_ts"]
        self.D = main * c["l_m"] ** 2 + tail * c["l_t"] ** 2
        self.E = c["m_b"] * c["l_b"] ** 2 / 3 + c["m_cb"] * c["l_cb"] ** 2
        self.F = c["m_ms"] * c["r_ms"] ** 2 + c["m_ts"] * c["r_ts"] ** 2 / 2
        self.H = (
            self.A * c["l_t"]
            + self.B * c["l_m"]
            + c["m_b"] * c["l_b"] ** 2 / 2
            + c["m_cb"] * c["l_cb"] ** 2
        )
        shields = c["m_ms"] * c["r_ms"] ** 2 / 2 + c["m_ts"] * c["r_ts"] ** 2 / 2
        self.J_v = self.D + self.E + shields

    def settle(self, driver: Driver, duration: float) -> None:
        """Come to rest at the first command."""
        for line, angle in zip(self.late, self.x[4:], strict=True):
            line.settle(angle)
        if not duration:
            return
        first = np.clip(driver.command(0, 0.0, self.measure()), -COMMAND_LIMIT, COMMAND_LIMIT)
        for _ in range(round(duration / STEP)):
            self._step(first)
            self.x[2:4] *= 0.999
        for line, angle in zip(self.late, self.x[4:], strict=True):
            line.settle(angle)
        self.time = 0.0

    def advance(self, command: FloatArray) -> None:
        for _ in range(self.steps):
            self._step(command)

    def measure(self) -> FloatArray:
        """The sensors, a little early or late."""
        size, n = self.rigs.size, len(self.rigs)
        ago = np.clip(np.abs(self.random.normal(0, self.rigs.nuisances.jitter, n)) / STEP, 0, 1)
        x = self.x + ago * (self.x_before - self.x)
        y = np.empty((n, 4))
        for i, axis in enumerate(("pitch", "yaw")):
            angle = self.late[i].read(x[4 + i])
            angle = angle + self.modes[i].seen + self.flexible[i].seen
            angle = angle + size(f"{axis}_sensor_bias", "bias")
            angle = angle + size(f"{axis}_encoder_eccentricity", "amplitude") * np.sin(3 * angle)
            coarse = np.maximum(size(f"{axis}_quantisation", "quantum"), PITCH_QUANTUM)
            y[:, i] = coarse * np.round(angle / coarse)
        for i, rotor in enumerate(("main", "tail")):
            lag = size(f"{rotor}_tacho_lag", "time_constant")
            speed = np.where(lag > 0, self.tacho[i], x[i])
            speed = speed + self.random.normal(0, SPEED_NOISE, n)
            y[:, 2 + i] = SPEED_QUANTUM * np.round(speed / SPEED_QUANTUM)
        return y

    def _step(self, command: FloatArray) -> None:
        self.time += STEP
        self.x_before = self.x
        self._drive(command)
        held = self._held_torques()
        now = self._slopes(self.x, held)
        guess = self.x + STEP * now
        x = self.x + STEP / 2 * (now + self._slopes(guess, held))
        for row, stop in ((4, PITCH_STOP), (5, YAW_STOP)):
            beyond = np.abs(x[row]) > stop
            x[row] = np.clip(x[row], -stop, stop)
            x[row - 2] = np.where(beyond, 0.0, x[row - 2])
        acceleration = (x[2:4] - self.x[2:4]) / STEP
        self.x = x
        for i in range(2):
            self.modes[i].advance(acceleration[i], STEP)
            self.flexible[i].advance(acceleration[i], STEP)
            self.late[i].push(x[4 + i])
            lag = self.rigs.size(("main_tacho_lag", "tail_tacho_lag")[i], "time_constant")
            self.tacho[i] += (x[i] - self.tacho[i]) * (1 - np.exp(-STEP / np.maximum(lag, 1e-6)))

    def _drive(self, command: FloatArray) -> None:
        """From the command to the voltage that the motors get."""
        size = self.rigs.size
        for i, rotor in enumerate(("main", "tail")):
            u = command[:, i]
            self.delays[i].push(u)
            u = self.delays[i].read(u)
            lag = size(f"{rotor}_actuator_lag", "time_constant")
            self.lagged[i] += (u - self.lagged[i]) * (1 - np.exp(-STEP / np.maximum(lag, 1e-6)))
            u = np.where(lag > 0, self.lagged[i], u)
            width = size(f"{rotor}_dead_zone", "width")
            u = u - np.clip(u, -width, width)
            load = (u / COMMAND_LIMIT) ** 2
            slow = size(f"{rotor}_supply_derating", "time_constant")
            share = 1 - np.exp(-STEP / np.maximum(slow, 1e-6))
            self.warmth[i] += (load - self.warmth[i]) * share
            u = u * (1 - size(f"{rotor}_supply_derating", "depth") * self.warmth[i])
            wander = np.sin(2 * np.pi * self.time / self.drift_period[i] + self.drift_phase[i])
            self.v[i] = u * (1 + np.sqrt(2) * self.rigs.nuisances.drift * wander)
        load = (command[:, 0] / COMMAND_LIMIT) ** 2  # of the main drive on a supply for both
        self.v[1] *= 1 - size("shared_supply_sag", "depth") * load

    def _held_torques(self) -> FloatArray:
        """Torques on pitch and yaw that are constant over an integration step."""
        size, x = self.rigs.size, self.x
        torque = np.stack([-self.friction[i].torque(x[2 + i], STEP) for i in range(2)])
        torque[1] -= self.cable.torque(x[5])
        for i, axis in enumerate(("pitch", "yaw")):
            sd, time = (size(f"{axis}_disturbance", s) for s in ("torque", "time"))
            if sd.any():
                kept = np.exp(-STEP / np.maximum(time, 1e-3))
                noise = self.random.standard_normal(len(self.rigs))
                self.push[i] = kept * self.push[i] + sd * np.sqrt(1 - kept**2) * noise
        return torque + self.push

    def _slopes(self, x: FloatArray, held: FloatArray) -> FloatArray:
        c, size = self.c, self.rigs.size
        w_m, w_t, q, r, theta, psi = x
        cos, sin = np.cos(theta), np.sin(theta)
        drag_m = np.where(w_m >= 0, c["k_tvp"], c["k_tvn"]) * w_m * np.abs(w_m)
        drag_t = np.where(w_t >= 0, c["k_thp"], c["k_thn"]) * w_t * np.abs(w_t)
        rub_m = size("main_rotor_friction", "torque") * np.tanh(w_m / 0.5)
        rub_t = size("tail_rotor_friction", "torque") * np.tanh(w_t / 0.5)
        motor_m = c["kphi"] * (c["k_uv"] * self.v[0] - c["kphi"] * w_m) / c["R"]
        motor_t = c["kphi"] * (c["k_uh"] * self.v[1] - c["kphi"] * w_t) / c["R"]
        dw_m = (motor_m - c["B_mr"] * w_m - drag_m - rub_m) / c["J_mr"]
        dw_t = (motor_t - c["B_tr"] * w_t - drag_t - rub_t) / c["J_tr"]
        thrust_m = self._thrust("main", w_m, c["k_fvp"], c["k_fvn"], c["l_m"] * q)
        thrust_t = self._thrust("tail", w_t, c["k_fhp"], c["k_fhn"], c["l_t"] * r)
        gain, scale = size("ground_effect", "gain"), size("ground_effect", "scale")
        height = size("ground_effect", "level_height") + c["l_m"] * sin
        near = gain * np.exp(-height / np.maximum(scale, 1e-3))
        thrust_m = thrust_m * np.where(thrust_m > 0, 1 + near, 1.0)
        thrust_m = thrust_m * (1 - size("main_thrust_loss_with_pitch", "share") * sin**2)

        inertia = self.D * cos**2 + self.E * sin**2 + self.F
        inertia_slope = 2 * (self.E - self.D) * sin * cos
        cable = np.where(psi >= 0, c["k_chp"], c["k_chn"]) * psi
        away = psi - size("yaw_cable_stiffness", "neutral")
        cable = cable + size("yaw_cable_stiffness", "stiffness") * away
        cable = cable + size("yaw_cable_stiffness", "cubic") * away**3
        caught = np.abs(psi) - size("yaw_cable_catch", "angle")
        cable = cable + size("yaw_cable_catch", "stiffness") * np.sign(psi) * np.maximum(caught, 0)
        yaw = c["l_t"] * thrust_t * cos - c["k_oh"] * r - cable + held[1]
        yaw = yaw - size("yaw_quadratic_damping", "coefficient") * r * np.abs(r)
        drag, spin = (size("main_reaction_on_yaw", s) for s in ("drag", "inertia"))
        yaw = yaw + (drag * w_m * np.abs(w_m) + spin * dw_m) * cos
        pitch = c["l_m"] * thrust_m + c["k_g"] * thrust_m * r * cos - c["k_ov"] * q + held[0]
        pitch = pitch + c["g"] * ((self.A - self.B) * cos - self.C * sin)
        pitch = pitch - self.H * r**2 * sin * cos
        pitch = pitch - size("pitch_quadratic_damping", "coefficient") * q * np.abs(q)
        drag, spin = (size("tail_reaction_on_pitch", s) for s in ("drag", "inertia"))
        pitch = pitch + drag * w_t * np.abs(w_t) + spin * dw_t
        lean = np.sin(theta + size("gyroscopic_coupling", "lean"))
        momentum = size("gyroscopic_coupling", "inertia") * w_m
        pitch, yaw = pitch + momentum * r * lean, yaw - momentum * q * lean
        pitch = pitch + size("pitch_cogging", "torque") * np.sin(12 * theta)
        yaw = yaw + size("yaw_cogging", "torque") * np.sin(8 * psi)

        mass, arm, rise = (size("pitch_mass_imbalance", s) for s in ("mass", "arm", "height"))
        behind, above = arm * cos + rise * sin, rise * cos - arm * sin
        pitch = pitch + mass * c["g"] * behind + mass * behind * above * r**2
        yaw = yaw - 2 * mass * behind * above * q * r
        own_m = c["k_m"] * (
            dw_m * cos / inertia
            - w_m * q * sin / inertia
            - w_m * cos * inertia_slope * q / inertia**2
        )
        own_t = c["k_t"] * dw_t / self.J_v
        dq = (pitch + own_t * self.J_v) / (self.J_v + mass * (arm**2 + rise**2))
        dr = (yaw + own_m * inertia) / (inertia + mass * behind**2)
        return np.stack([dw_m, dw_t, dq, dr, q, r])

    def _thrust(
        self, rotor: str, w: FloatArray, ahead: FloatArray, back: FloatArray, axial: FloatArray
    ) -> FloatArray:
        size = self.rigs.size
        thrust = np.where(w >= 0, ahead, back) * w * np.abs(w)
        exponent = size(f"{rotor}_thrust_curve", "exponent")
        if exponent.any():
            reference = np.maximum(size(f"{rotor}_thrust_curve", "reference"), 1.0)
            thrust = thrust * np.maximum(np.abs(w) / reference, 1e-6) ** exponent
        thrust = thrust * np.where(w < 0, 1 + size(f"{rotor}_thrust_curve", "reverse"), 1.0)
        inflow = size(f"{rotor}_inflow", "coefficient")
        if inflow.any():
            thrust = thrust - inflow * axial * thrust * w / np.maximum(w**2, 1e-6)
        return thrust
