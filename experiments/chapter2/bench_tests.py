"""Parameters from bench tests, each on a simulated rig with the noise of its instruments.

The rig is the Lagrangian model itself: the tests show what their instruments allow, not what a
model that is wrong would cost. Each takes the masses, lengths, R and kφ as known.

==================  =======================================================================
static curves       at rest speeds, ``kφ i = B ω + k_t ω|ω|`` and ``F = k_f ω|ω|``: least
                    squares in B, k_t and k_f, each by direction
run-down            terminals open, ``J ω̇ = −B ω − k_t ω²``, which has a closed form: J from
                    the decay with B and k_t of the static curves
yaw on the cable    pitch locked, ``k_ch α_h = l_t F_h(ω_h)`` at rest: k_ch by direction
free swing          yaw locked, no command: k_ov and l_cb by least squares with exact slopes
==================  =======================================================================
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from experiments.chapter2.simulation import FloatArray, OpenLoop
from experiments.chapter2.study import Study, times
from trms_cli.models.lagrangian import Lagrangian
from trms_cli.models.single_rotor import SingleRotor
from trms_cli.simulation.rollout import Rollout

_SETTLED = 12.0  # s, a rotor
_YAW_SETTLED = 60.0  # s
#: With this resistance in its circuit a motor's terminals are open.
_OPEN = 1e9
_ROTORS = {"main": ("v", "mr"), "tail": ("h", "tr")}


@dataclass(frozen=True)
class BenchTestResult:
    """A parameter by its test."""

    name: str
    unit: str
    test: str
    true: float
    mean: float  #: Over the repetitions, in the parameter's unit
    sd: float  #: Over the repetitions, in the parameter's unit

    @property
    def bias_percent(self) -> float:
        return 100 * (self.mean - self.true) / self.true

    @property
    def sd_percent(self) -> float:
        return 100 * self.sd / abs(self.true)


@dataclass(frozen=True)
class BenchRecords:
    """One repetition as its figure shows it; SI."""

    #: dict of str to (ω, kφ i, F) arrays; by rotor, measured
    static: dict[str, tuple[FloatArray, FloatArray, FloatArray]]
    #: dict of str to (time, ω measured, ω fitted) arrays
    run_down: dict[str, tuple[FloatArray, FloatArray, FloatArray]]
    cable: tuple[FloatArray, FloatArray]  #: (α_h, moment) arrays
    swing: tuple[FloatArray, FloatArray, FloatArray]  #: (time, α_v measured, α_v fitted) arrays


def study_bench_tests(study: Study, seed: int = 0) -> tuple[list[BenchTestResult], BenchRecords]:
    """All tests, as often as the study asks."""
    rig = {p.name: p for p in Lagrangian().parameters}
    clean = _Clean.simulated(study)
    generator = np.random.default_rng(seed)
    samples: dict[str, list[float]] = {}
    records: BenchRecords | None = None
    for _ in range(study.bench_tests.repetitions):
        estimates, record = _once(study, clean, {n: p.value for n, p in rig.items()}, generator)
        records = records or record
        for name, value in estimates.items():
            samples.setdefault(name, []).append(value)
    assert records is not None
    return [
        BenchTestResult(
            name,
            rig[name].unit,
            _test_of(name),
            rig[name].value,
            float(np.mean(values)),
            float(np.std(values, ddof=1)),
        )
        for name, values in samples.items()
    ], records


@dataclass(frozen=True)
class _Clean:
    """What the tests would measure without noise."""

    static: dict[str, tuple[FloatArray, FloatArray, FloatArray]]  # ω, i, F
    run_down: dict[str, tuple[FloatArray, FloatArray]]  # time, ω
    cable: tuple[FloatArray, FloatArray]  # ω_h, α_h
    swing: Rollout

    @classmethod
    def simulated(cls, study: Study) -> _Clean:
        settings, T, n = study.bench_tests, study.sample_time, study.substeps
        static, run_down = {}, {}
        for rotor, (axis, _) in _ROTORS.items():
            model = SingleRotor(rotor=rotor, load_cell=True)  # type: ignore[arg-type]
            bench = OpenLoop(model, T, n)
            c = {p.name: p.value for p in model.parameters}
            u = np.linspace(-2.5, 2.5, settings.static_points)
            u = u[np.abs(u) > 0.2]
            unit_command = np.ones((len(times(_SETTLED, T)), 1))
            ends = [bench.respond(value * unit_command).outputs for value in u]
            omega = np.array([y[f"omega_{axis}"][-1] for y in ends])
            thrust = np.array([y[f"thrust_{axis}"][-1] for y in ends])
            current = (c[f"k_u{axis}"] * u - c["kphi"] * omega) / c["R"]
            static[rotor] = (omega, current, thrust)
            opened = model.parameters.replaced({"R": _OPEN}).values
            t = times(settings.run_down_duration, T)
            first = settings.run_down_speed if axis == "v" else settings.run_down_speed_tail
            decay = bench.respond(np.zeros((len(t), 1)), {f"omega_{axis}": first}, opened)
            run_down[rotor] = (t, decay.outputs[f"omega_{axis}"])
        yaw = OpenLoop(Lagrangian(freedom="horizontal"), T, n, stops=False)
        unit_command = np.ones((len(times(_YAW_SETTLED, T)), 1))
        ends = [yaw.respond(value * unit_command).outputs for value in settings.yaw_commands]
        cable = tuple(np.array([y[name][-1] for y in ends]) for name in ("omega_h", "alpha_h"))
        swing = Rollout(Lagrangian(freedom="vertical"), T, free=("k_ov", "l_cb"), substeps=1)
        return cls(static, run_down, (cable[0], cable[1]), swing)


def _once(
    study: Study, clean: _Clean, c: dict[str, float], generator: np.random.Generator
) -> tuple[dict[str, float], BenchRecords]:
    settings = study.bench_tests
    estimates: dict[str, float] = {}
    static, run_down = {}, {}

    def noisy(values: FloatArray, sd: float) -> FloatArray:
        return values + sd * generator.standard_normal(values.shape)

    def encoder(values: FloatArray) -> FloatArray:
        return np.round(values / settings.angle_quantum) * settings.angle_quantum

    for rotor, (axis, suffix) in _ROTORS.items():
        omega = noisy(clean.static[rotor][0], settings.speed_noise)
        current = noisy(clean.static[rotor][1], settings.current_noise)
        force = noisy(clean.static[rotor][2], settings.force_noise)
        square = omega * np.abs(omega)
        sides = np.stack([square * (omega > 0), square * (omega < 0)], axis=-1)
        rows = np.column_stack([omega, sides])
        friction = np.linalg.lstsq(rows, c["kphi"] * current, rcond=None)[0]
        thrust = np.linalg.lstsq(sides, force, rcond=None)[0]
        values = (friction[0], friction[1], friction[2], thrust[0], thrust[1])
        names = (f"B_{suffix}", f"k_t{axis}p", f"k_t{axis}n", f"k_f{axis}p", f"k_f{axis}n")
        estimates |= {name: float(value) for name, value in zip(names, values, strict=True)}
        static[rotor] = (omega, c["kphi"] * current, force)
        time, decay = clean.run_down[rotor]
        measured = noisy(decay, settings.speed_noise)
        inertia, fitted = _inertia(time, measured, max(friction[0], 0.0), friction[1])
        estimates[f"J_{suffix}"] = inertia
        run_down[rotor] = (time, measured, fitted)

    omega = noisy(clean.cable[0], settings.speed_noise)
    yaw = encoder(clean.cable[1])
    gains = np.where(omega > 0, estimates["k_fhp"], estimates["k_fhn"])
    moment = c["l_t"] * gains * omega * np.abs(omega)
    for name, side in (("k_chp", yaw > 0), ("k_chn", yaw < 0)):
        estimates[name] = float(yaw[side] @ moment[side] / (yaw[side] @ yaw[side]))

    # Released by hand: never from the same angle twice.
    time = times(settings.swing_duration, study.sample_time)
    start = clean.swing.model.rest()
    start[2] += settings.swing_start * (1 + 0.2 * generator.uniform(-1, 1))
    still = np.zeros((len(time), 1))
    measured = encoder(clean.swing.outputs(still, [0], [len(still)], start[None, :]).y[:, 0])
    swing, fitted = _swing(clean.swing, measured, c, generator)
    estimates |= swing
    return estimates, BenchRecords(static, run_down, (yaw, moment), (time, measured, fitted))


def _inertia(
    time: FloatArray, omega: FloatArray, friction: float, drag: float
) -> tuple[float, FloatArray]:
    """J of ``J ω̇ = −B ω − k ω²`` and the fitted decay.

    With ``s = e^{−B t/J}``, ``ω = ω_0 s/(1 + (k ω_0/B)(1 − s))``.
    """
    from scipy.optimize import least_squares

    friction = max(friction, 1e-9)

    def decay(p: FloatArray) -> FloatArray:
        first, inertia = p[0], np.exp(p[1])
        # −expm1 keeps the difference where the friction is slight.
        decline = -np.expm1(-friction / inertia * time)
        return np.asarray(first * (1 - decline) / (1 + drag * first / friction * decline))

    start = np.array([omega[0], np.log(1e-4)])
    best = least_squares(lambda p: decay(p) - omega, start, x_scale=[100.0, 1.0])
    return float(np.exp(best.x[1])), decay(best.x)


def _swing(
    model: Rollout, measured: FloatArray, c: dict[str, float], generator: np.random.Generator
) -> tuple[dict[str, float], FloatArray]:
    """k_ov and l_cb from a free swing, from a start that is 10 % wrong.

    Free are the momentum and the angle at the start and the two parameters; not the rotor.
    """
    from scipy.optimize import least_squares

    names = ("k_ov", "l_cb")
    nominal = np.array([c[name] for name in names])
    still = np.zeros((len(measured), 1))
    parameters = model.model.parameters
    x = model.model.rest()

    def simulated(z: FloatArray) -> tuple[FloatArray, FloatArray]:
        values = dict(zip(names, (z[2:] * nominal).tolist(), strict=True))
        x[1:] = z[:2]
        p = parameters.replaced(values).values
        result = model.sensitivities(still, [0], [len(still)], x[None, :], p)
        slopes = result.dy[:, 0, 1:] * np.concatenate([[1.0, 1.0], nominal])
        return result.y[:, 0], slopes

    first = np.concatenate([[0.0, measured[0]], 1 + 0.1 * generator.standard_normal(2)])
    best = least_squares(
        lambda z: simulated(z)[0] - measured,
        np.clip(first, [-1, -2, 0.7, 0.7], [1, 2, 1.3, 1.3]),
        lambda z: simulated(z)[1],
        bounds=([-2, -2, 0.1, 0.6], [2, 2, 10, 1.5]),
        xtol=1e-10,
    )
    estimates = dict(zip(names, (best.x[2:] * nominal).tolist(), strict=True))
    return estimates, simulated(best.x)[0].copy()


def _test_of(name: str) -> str:
    if name.startswith("J_"):
        return "run-down"
    if name.startswith("k_ch"):
        return "yaw on the cable"
    return "free swing" if name in ("k_ov", "l_cb") else "static curve"
