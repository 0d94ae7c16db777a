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
jitter, a drive gain that drifts by up to a few percent, a slight flexibility before the encoders,
sensors of another noise and step, laws of a slightly other form. Only the parameter values are the
models': they are data. An effect may begin within a run; what no library has is in
:mod:`.outside_laws`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

from experiments.gap.blind.outside_laws import OutsideLaws
from experiments.gap.blind.parts import Bristles, DelayLine, Oscillator, Slips

FloatArray = npt.NDArray[np.float64]

STEP = 1e-3  #: s, of the integration
PITCH_QUANTUM = YAW_QUANTUM = 2 * np.pi / 4096  #: rad
SPEED_QUANTUM = 0.4917  #: rad/s
SPEED_NOISE = 1.6  #: rad/s
PITCH_STOP, YAW_STOP = 1.05, 2.8  #: rad
COMMAND_LIMIT = 2.5  #: V
#: rad/s. Speeds of the rotors at which another law of thrust or drag is equal to the usual one.
USUAL_SPEED = {"main": 200.0, "tail": 300.0}


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


@dataclass(frozen=True, kw_only=True)
class Nuisances:
    """What every rig has and nobody asks for: a float for all rigs, or an (n,) array."""

    jitter: float | FloatArray = 2e-4  #: s, standard deviation of the sampling instants
    #: Share by which a drive's gain wanders over a recording, standard deviation
    drift: float | FloatArray = 0.01
    #: s, correlation time of that wandering (Ornstein-Uhlenbeck); 0: a sine of 40 to 200 s
    drift_time: float | FloatArray = 0.0
    #: Share of the deflection of a stiff mode that the encoders see
    flexibility: float | FloatArray = 0.3
    speed_noise: float | FloatArray = 1.0  #: Of the tachos, in units of :data:`SPEED_NOISE`
    speed_quantum: float | FloatArray = 1.0  #: Their step, in units of :data:`SPEED_QUANTUM`
    angle_noise: float | FloatArray = 0.0  #: rad, standard deviation of white noise on the angles
    pitch_quantum: float | FloatArray = 1.0  #: Step of an encoder, in units of 2π/4096
    yaw_quantum: float | FloatArray = 1.0  #: Step of an encoder, in units of 2π/4096
    # Laws of effects, of slightly other form than the library's: they change the effect alone.
    bend: float | FloatArray = 2e-4  #: rad, at which bristles slide
    #: Share by which friction at rest exceeds that in motion, beside what an effect has
    stick: float | FloatArray = 0.0
    slip_spread: float | FloatArray = 1.0  #: Factor on where a cable's springs slip
    damping_exponent: float | FloatArray = 2.0  #: Of quadratic damping, equal at 1 rad/s
    #: rad/s, of a rotor at which its friction has reached three quarters
    rub_speed: float | FloatArray = 0.5
    # Laws of the nominal model: they leave a standing error.
    viscous_exponent: float | FloatArray = 1.0  #: Of the axes' own friction, equal at 0.3 rad/s
    #: Added to that of the thrust laws, which stay equal at 200 (main) and 300 rad/s (tail)
    thrust_exponent: float | FloatArray = 0.0
    #: rad⁻², by which the cable's own stiffness grows with the square of the angle
    cable_hardening: float | FloatArray = 0.0
    pitch_inertia: float | FloatArray = 1.0  #: Factor on the moment of inertia alone
    yaw_inertia: float | FloatArray = 1.0  #: Factor on the moment of inertia alone
    # Laws of the nominal model that no power describes: shares by which each is larger at zero, and
    # smaller far out, see :func:`_curved`. Equal at 0.3 rad/s, 200 and 300 rad/s, 0.5 rad.
    viscous_curve: float | FloatArray = 0.0
    thrust_curve: float | FloatArray = 0.0
    drag_curve: float | FloatArray = 0.0  #: Of the rotors
    cable_curve: float | FloatArray = 0.0


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
    #: dict of str to (n,) array; s, from when a size of that name is there; 0: always. Not for
    #: delays and modes.
    onsets: Mapping[str, FloatArray] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.constants["g"])

    def begin(self, sample_time: float) -> RigsInMotion:
        """All rigs hanging at rest; ``sample_time``: s, a whole number of integration steps."""
        motion = RigsInMotion(self, sample_time)
        motion.rest()
        return motion

    def run(
        self, driver: Driver, duration: float, sample_time: float, settling: float = 20.0
    ) -> RigRecordings:
        """Drive all rigs for a while.

        ``duration``, ``sample_time``: s; a sample is a whole number of integration steps.
        ``settling``: s at the first command before, with the axes braked, so that no run begins
        wild; with 0 a run begins hanging at rest.
        """
        run = self.begin(sample_time)
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


class RigsInMotion:
    """The state of all rigs during a run."""

    def __init__(self, rigs: Rigs, sample_time: float) -> None:
        self.rigs, self.c, self.own, size = rigs, rigs.constants, rigs.nuisances, self.size
        n = len(rigs)
        self.none = np.zeros(n)
        self.waiting = sorted({t for at in rigs.onsets.values() for t in at.tolist() if t > 0})
        self.sizes = self._sizes_at(0.0)
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
        self.wandering = bool(np.any(self.own.drift_time))
        self.wander = self.random.standard_normal((2, n)) if self.wandering else np.zeros((2, n))
        rotors, axes = ("main", "tail"), ("pitch", "yaw")
        self.delays = [DelayLine(size(f"{r}_input_delay", "delay"), 0.2, STEP) for r in rotors]
        self.friction = [
            Bristles(inertia, self.own.bend) for inertia in (self.J_v, self.D + self.F)
        ]
        self.cable = Slips(self.own.slip_spread)
        self._shape()
        self.push = np.zeros((2, n))  #: External torques on pitch and yaw, N m
        share = self.none + self.own.flexibility
        self.modes = [Oscillator(share, np.full(n, 21.0), np.full(n, 0.03)) for _ in axes]
        self.flexible = [
            Oscillator(*(size(f"{a}_flexible_mode", s) for s in ("share", "frequency", "damping")))
            for a in axes
        ]
        self.late = [DelayLine(size(f"{a}_sensor_delay", "delay"), 0.2, STEP) for a in axes]
        self.tacho = np.zeros((2, n))
        self.outside = OutsideLaws(size, n, STEP)

    def size(self, effect: str, name: str) -> FloatArray:
        """A size of an effect for every rig, (n,); zero where it has not begun."""
        return self.sizes.get(f"{effect}.{name}", self.none)

    def _sizes_at(self, time: float) -> dict[str, FloatArray]:
        """The sizes that are there at a time, s."""
        onsets = self.rigs.onsets
        return {
            name: np.where(onsets[name] <= time, value, 0.0) if name in onsets else value
            for name, value in self.rigs.sizes.items()
        }

    def _shape(self) -> None:
        """Tell their sizes to parts that keep some."""
        size = self.size
        for part, axis in zip(self.friction, ("pitch", "yaw"), strict=True):
            stribeck = f"{axis}_stribeck_friction"
            part.shape(
                size(f"{axis}_coulomb_friction", "torque") + size(stribeck, "torque"),
                size(stribeck, "excess") + self.own.stick,
                np.where(size(stribeck, "velocity") > 0, size(stribeck, "velocity"), 0.03),
            )
        self.cable.shape(
            size("yaw_cable_hysteresis", "torque"), size("yaw_cable_hysteresis", "width")
        )

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
        self.J_v = (self.D + self.E + shields) * self.own.pitch_inertia

    def rest(self) -> None:
        """As if the axes had been where they are for long."""
        for line, angle in zip(self.late, self.x[4:], strict=True):
            line.settle(angle)

    def settle(self, driver: Driver, duration: float) -> None:
        """Come to rest at the first command."""
        self.rest()
        if not duration:
            return
        first = np.clip(driver.command(0, 0.0, self.measure()), -COMMAND_LIMIT, COMMAND_LIMIT)
        for _ in range(round(duration / STEP)):
            self._step(first)
            self.x[2:4] *= 0.999
        self.rest()
        self.time = 0.0

    def advance(self, command: FloatArray) -> None:
        """One sample on."""
        if self.wandering:
            decay = np.exp(-self.steps * STEP / np.maximum(self.own.drift_time, 1e-3))
            noise = self.random.standard_normal(self.wander.shape)
            self.wander = decay * self.wander + np.sqrt(1 - decay**2) * noise
        for _ in range(self.steps):
            if self.waiting and self.time >= self.waiting[0]:
                self.waiting.pop(0)
                self.sizes = self._sizes_at(self.time)
                self._shape()
            self._step(command)

    def measure(self) -> FloatArray:
        """The sensors, a little early or late."""
        size, own, n = self.size, self.own, len(self.rigs)
        ago = np.clip(np.abs(self.random.normal(0, own.jitter, n)) / STEP, 0, 1)
        x = self.x + ago * (self.x_before - self.x)
        y = np.empty((n, 4))
        quanta = (PITCH_QUANTUM * own.pitch_quantum, YAW_QUANTUM * own.yaw_quantum)
        noisy = bool(np.any(own.angle_noise))
        for i, axis in enumerate(("pitch", "yaw")):
            angle = self.late[i].read(x[4 + i])
            angle = angle + self.modes[i].angle_contribution + self.flexible[i].angle_contribution
            angle = angle + size(f"{axis}_sensor_bias", "bias")
            angle = angle + size(f"{axis}_encoder_eccentricity", "amplitude") * np.sin(3 * angle)
            angle = self.outside.encoder_angle(axis, angle, x, self.time)
            if noisy:
                angle = angle + self.random.normal(0, 1, n) * own.angle_noise
            coarse = np.maximum(size(f"{axis}_quantisation", "quantum"), quanta[i])
            y[:, i] = coarse * np.round(angle / coarse)
        y[:, :2] = self.outside.hold_last(y[:, :2], self.steps * STEP, self.random)
        step = SPEED_QUANTUM * own.speed_quantum
        for i, rotor in enumerate(("main", "tail")):
            lag = size(f"{rotor}_tacho_lag", "time_constant")
            speed = np.where(lag > 0, self.tacho[i], x[i])
            speed = speed + self.random.normal(0, SPEED_NOISE, n) * own.speed_noise
            y[:, 2 + i] = step * np.round(speed / step)
        return y

    def _step(self, command: FloatArray) -> None:
        self.time += STEP
        self.x_before = self.x
        self._drive(command)
        torques = self._constant_torques()
        now = self._slopes(self.x, torques)
        guess = self.x + STEP * now
        x = self.x + STEP / 2 * (now + self._slopes(guess, torques))
        for row, stop in ((4, PITCH_STOP), (5, YAW_STOP)):
            beyond = np.abs(x[row]) > stop
            x[row] = np.clip(x[row], -stop, stop)
            x[row - 2] = np.where(beyond, 0.0, x[row - 2])
        acceleration = (x[2:4] - self.x[2:4]) / STEP
        self.x = x
        self.outside.advance(x)
        for i in range(2):
            self.modes[i].advance(acceleration[i], STEP)
            self.flexible[i].advance(acceleration[i], STEP)
            self.late[i].push(x[4 + i])
            lag = self.size(("main_tacho_lag", "tail_tacho_lag")[i], "time_constant")
            self.tacho[i] += (x[i] - self.tacho[i]) * (1 - np.exp(-STEP / np.maximum(lag, 1e-6)))

    def _drive(self, command: FloatArray) -> None:
        """From the command to the voltage that the motors get."""
        size = self.size
        for i, rotor in enumerate(("main", "tail")):
            u = command[:, i]
            self.delays[i].push(u)
            u = self.delays[i].read(u)
            lag = size(f"{rotor}_actuator_lag", "time_constant")
            self.lagged[i] += (u - self.lagged[i]) * (1 - np.exp(-STEP / np.maximum(lag, 1e-6)))
            u = np.where(lag > 0, self.lagged[i], u)
            u = self.outside.drive_voltage(rotor, u)
            width = size(f"{rotor}_dead_zone", "width")
            u = u - np.clip(u, -width, width)
            load = (u / COMMAND_LIMIT) ** 2
            slow = size(f"{rotor}_supply_derating", "time_constant")
            share = 1 - np.exp(-STEP / np.maximum(slow, 1e-6))
            self.warmth[i] += (load - self.warmth[i]) * share
            u = u * (1 - size(f"{rotor}_supply_derating", "depth") * self.warmth[i])
            wander = np.sin(2 * np.pi * self.time / self.drift_period[i] + self.drift_phase[i])
            wander = np.where(
                np.greater(self.own.drift_time, 0), self.wander[i], np.sqrt(2) * wander
            )
            self.v[i] = u * (1 + self.own.drift * wander)
        load = (command[:, 0] / COMMAND_LIMIT) ** 2  # of the main drive on a supply for both
        self.v[1] *= 1 - size("shared_supply_sag", "depth") * load

    def _constant_torques(self) -> FloatArray:
        """Torques on pitch and yaw that are constant over an integration step."""
        size, x = self.size, self.x
        torque = np.stack([-self.friction[i].torque(x[2 + i], STEP) for i in range(2)])
        torque[1] -= self.cable.torque(x[5])
        torque += self.outside.torques(x, self.time)
        for i, axis in enumerate(("pitch", "yaw")):
            sd, time = (size(f"{axis}_disturbance", s) for s in ("torque", "time"))
            if sd.any():
                decay = np.exp(-STEP / np.maximum(time, 1e-3))
                noise = self.random.standard_normal(len(self.rigs))
                self.push[i] = decay * self.push[i] + sd * np.sqrt(1 - decay**2) * noise
        return torque + self.push

    def _slopes(self, x: FloatArray, torques: FloatArray) -> FloatArray:
        c, size, own = self.c, self.size, self.own
        w_m, w_t, q, r, theta, psi = x
        cos, sin = np.cos(theta), np.sin(theta)
        drag_m = np.where(w_m >= 0, c["k_tvp"], c["k_tvn"]) * w_m * np.abs(w_m)
        drag_m = drag_m * _curved(w_m, USUAL_SPEED["main"], own.drag_curve)
        drag_t = np.where(w_t >= 0, c["k_thp"], c["k_thn"]) * w_t * np.abs(w_t)
        drag_t = drag_t * _curved(w_t, USUAL_SPEED["tail"], own.drag_curve)
        rub_m = size("main_rotor_friction", "torque") * np.tanh(w_m / own.rub_speed)
        rub_t = size("tail_rotor_friction", "torque") * np.tanh(w_t / own.rub_speed)
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
        thrust_m, thrust_t = self.outside.thrusts(thrust_m, thrust_t, w_t)

        inertia = (self.D * cos**2 + self.E * sin**2 + self.F) * own.yaw_inertia
        inertia_slope = 2 * (self.E - self.D) * sin * cos * own.yaw_inertia
        cable = (
            np.where(psi >= 0, c["k_chp"], c["k_chn"]) * psi * (1 + own.cable_hardening * psi**2)
        )
        cable = cable * _curved(psi, 0.5, own.cable_curve)
        away = psi - size("yaw_cable_stiffness", "neutral")
        cable = cable + size("yaw_cable_stiffness", "stiffness") * away
        cable = cable + size("yaw_cable_stiffness", "cubic") * away**3
        caught = np.abs(psi) - size("yaw_cable_catch", "angle")
        cable = cable + size("yaw_cable_catch", "stiffness") * np.sign(psi) * np.maximum(caught, 0)
        yaw = c["l_t"] * thrust_t * cos - c["k_oh"] * _viscous(r, own) - cable + torques[1]
        yaw = yaw - size("yaw_quadratic_damping", "coefficient") * _power(r, own.damping_exponent)
        drag, spin = (size("main_reaction_on_yaw", s) for s in ("drag", "inertia"))
        yaw = yaw + (drag * w_m * np.abs(w_m) + spin * dw_m) * cos
        pitch = c["l_m"] * thrust_m + c["k_g"] * thrust_m * r * cos + torques[0]
        pitch = pitch - c["k_ov"] * _viscous(q, own)
        pitch = pitch + c["g"] * ((self.A - self.B) * cos - self.C * sin)
        pitch = pitch - self.H * r**2 * sin * cos
        damping = size("pitch_quadratic_damping", "coefficient")
        pitch = pitch - damping * _power(q, own.damping_exponent)
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
        size = self.size
        thrust = np.where(w >= 0, ahead, back) * w * np.abs(w)
        if np.any(self.own.thrust_exponent):
            usual = USUAL_SPEED[rotor]
            thrust = thrust * np.maximum(np.abs(w) / usual, 1e-6) ** self.own.thrust_exponent
        thrust = thrust * _curved(w, USUAL_SPEED[rotor], self.own.thrust_curve)
        exponent = size(f"{rotor}_thrust_curve", "exponent")
        if exponent.any():
            reference = np.maximum(size(f"{rotor}_thrust_curve", "reference"), 1.0)
            thrust = thrust * np.maximum(np.abs(w) / reference, 1e-6) ** exponent
        thrust = thrust * np.where(w < 0, 1 + size(f"{rotor}_thrust_curve", "reverse"), 1.0)
        inflow = size(f"{rotor}_inflow", "coefficient")
        if inflow.any():
            thrust = thrust - inflow * axial * thrust * w / np.maximum(w**2, 1e-6)
        return thrust


def _viscous(rate: FloatArray, own: Nuisances) -> FloatArray:
    """A rate, rad/s, or what stands for it where friction does not grow with its first power."""
    if np.any(np.not_equal(own.viscous_exponent, 1.0)):
        rate = 0.3 * _power(rate / 0.3, own.viscous_exponent)
    return rate * _curved(rate, 0.3, own.viscous_curve)


def _curved(x: FloatArray, usual: float, share: float | FloatArray) -> float | FloatArray:
    """Factor on a law that is larger by a share at zero, and smaller by as much far out."""
    if not np.any(share):
        return 1.0
    size = np.abs(x)
    return 1 + share * (usual - size) / (usual + size)


def _power(x: FloatArray, exponent: float | FloatArray) -> FloatArray:
    """``sgn(x) |x|^exponent``."""
    signed_power: FloatArray = np.sign(x) * np.abs(x) ** exponent
    return signed_power
