"""The compiled simulation of windows against the discretised model, called step by step."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from trms_cli.core import compilation
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ModelError
from trms_cli.effects.coulomb_friction import CoulombFriction
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.input_delay import InputDelay
from trms_cli.models.discretisation import discretise
from trms_cli.models.driven_model import DrivenModel
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian
from trms_cli.simulation.rollout import Rollout

SAMPLE = 0.04  # s: two integration steps
FREE = ("k_fvp", "k_ov", "k_m", "J_tr")
FIRST, COUNT = np.array([0, 25, 60]), np.array([30, 45, 40])


def commands(n: int = 100, n_u: int = 2) -> np.ndarray:
    generator = np.random.default_rng(3)
    return np.repeat(generator.uniform(-1.0, 1.5, (n // 20, n_u)), 20, axis=0)


def starts(rollout: Rollout) -> np.ndarray:
    generator = np.random.default_rng(4)
    x = np.array([rollout.initial(rollout.model.rest(), c) for c in commands()[FIRST]])
    x[:, : rollout.model.n_x] += 0.1 * generator.standard_normal((3, rollout.model.n_x))
    return x


def step_by_step(model: Model, x0: np.ndarray) -> np.ndarray:
    discrete = discretise(model, SAMPLE, 2)
    step, measure = BufferedFunction(discrete.step), BufferedFunction(discrete.measurement)
    p, w, rows = model.parameters.values, np.zeros(model.n_w), []
    for j, x in enumerate(x0.copy()):
        for k in range(COUNT[j]):
            u = commands()[FIRST[j] + k]
            rows.append(measure.evaluate(x, u, p)[0].copy())
            x = step.evaluate(x, u, p, w)[0].copy()
    return np.array(rows)


@pytest.fixture(scope="module")
def plain() -> Rollout:
    return Rollout(Newtonian(), SAMPLE, free=FREE)


def with_friction_and_delay() -> Model:
    return extend_model(
        Newtonian(),
        {
            "yaw_coulomb_friction": CoulombFriction(axis="yaw", torque=0.005),
            "main_input_delay": InputDelay(rotor="main", delay=0.05),
        },
    )


@pytest.mark.parametrize("model", [Newtonian(), with_friction_and_delay()], ids=["plain", "memory"])
def test_it_is_the_discretised_model(model):
    rollout = Rollout(model, SAMPLE)
    x0 = starts(rollout)
    simulated = rollout.outputs(commands(), FIRST, COUNT, x0)
    np.testing.assert_allclose(simulated.y, step_by_step(rollout.model, x0), rtol=1e-12, atol=1e-13)


def test_windows_join(plain):
    """The end of a window is the start of the next."""
    whole = plain.outputs(commands(), [0], [80], starts(plain)[:1])
    half = plain.outputs(commands(), [0], [40], starts(plain)[:1])
    rest = plain.outputs(commands(), [40], [40], half.ends)
    np.testing.assert_array_equal(np.vstack([half.y, rest.y]), whole.y)
    np.testing.assert_array_equal(rest.ends, whole.ends)


def test_states_that_are_put_right_are_carried_on_from_sample_to_sample(plain):
    at, p = np.array([0, 25, 25, 60, 99]), plain.model.parameters.values
    states = np.full((5, plain.n_x), np.nan)
    states[0] = starts(plain)[0]
    states[1:, 0] = [0.1, 0.2, 0.3, 0.4]
    simulated = plain.carried(commands(), at, states, p)
    expected = states.copy()
    for j, count in enumerate(np.diff(at)):
        end = expected[j]
        if count:
            end = plain.outputs(commands(), [at[j]], [count], expected[j : j + 1], p).ends[0]
        expected[j + 1, 1:] = end[1:]
    np.testing.assert_array_equal(simulated, expected)


def test_what_diverges_is_not_carried_on(plain):
    states = np.full((2, plain.n_x), np.nan)
    states[0] = starts(plain)[0]
    states[0, 1] = 1e300
    after = plain.carried(commands(), np.array([0, 40]), states, plain.model.parameters.values)[1]
    assert np.isfinite(after).all()
    assert after[1] == 1e300


@pytest.mark.parametrize("column", range(6 + len(FREE)))
def test_slopes_are_those_of_the_simulation(plain, column):
    x0, p = starts(plain), plain.model.parameters.values
    exact = plain.sensitivities(commands(), FIRST, COUNT, x0)
    ends, values = [], []
    index = plain.model.parameters.names.index(FREE[column - 6]) if column >= 6 else -1
    size = 1e-5 * (p[index] if column >= 6 else 1.0)
    for sign in (1, -1):
        moved_x, moved_p = x0.copy(), p.copy()
        if column < 6:
            moved_x[:, column] += sign * size
        else:
            moved_p[index] += sign * size
        simulated = plain.outputs(commands(), FIRST, COUNT, moved_x, moved_p)
        values.append(simulated.y)
        ends.append(simulated.ends)
    slope, end = exact.dy[:, :, column], exact.dends[:, :, column]
    for found, differences in ((slope, values), (end, ends)):
        expected = (differences[0] - differences[1]) / (2 * size)
        scale = np.maximum(np.abs(expected).max(axis=0), 1e-6 * np.abs(expected).max() + 1e-300)
        # The model bends where a rotor turns round: there a difference quotient is not exact.
        assert np.quantile(np.abs(found - expected) / scale, 0.99) < 1e-4


@pytest.fixture
def no_compiler(plain, monkeypatch):
    """From here on nothing is compiled; what was before is."""
    plain.sensitivities(commands(), FIRST, COUNT, starts(plain))  # its slopes are, when first used
    monkeypatch.setenv("TRMS_COMPILE", "0")
    compilation.compiler.cache_clear()
    yield
    compilation.compiler.cache_clear()


@pytest.mark.skipif(compilation.compiler() is None, reason="no C compiler: nothing to compare with")
def test_with_and_without_a_compiler(plain, no_compiler):
    interpreted = Rollout(Newtonian(), SAMPLE, free=FREE)
    assert interpreted._plain.library is None
    call = (commands(), FIRST, COUNT, starts(plain))
    for compiled, slow in (
        (plain.outputs(*call), interpreted.outputs(*call)),
        (plain.sensitivities(*call), interpreted.sensitivities(*call)),
    ):
        for a, b in zip(compiled, slow, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * np.abs(a).max())
    states = np.full((3, plain.n_x), np.nan)
    states[0], states[1:, 0] = starts(plain)[0], 0.2
    p = plain.model.parameters.values
    a, b = (rollout.carried(commands(), FIRST, states, p) for rollout in (plain, interpreted))
    np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * np.abs(a).max())


def test_without_a_compiler_threads_do_not_mix(no_compiler):
    """A search without gradients: slopes in the starts only, several points at a time."""
    interpreted = Rollout(Newtonian(), SAMPLE)
    x0 = starts(interpreted)
    points = [factor * interpreted.model.parameters.values for factor in (1.0, 1.1, 1.2, 1.3)]

    def simulated(p: np.ndarray) -> np.ndarray:
        return interpreted.sensitivities(commands(), FIRST, COUNT, x0, p).dy

    alone = [simulated(p) for p in points]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(simulated, points))
    for a, b in zip(alone, together, strict=True):
        np.testing.assert_array_equal(a, b)


def test_threads_change_nothing(plain):
    n = 6000
    u = np.tile(commands(), (n // 100, 1))
    first, count = np.arange(0, n, 250), np.full(n // 250, 250)
    x0 = np.tile(plain.model.rest(), (len(first), 1))
    shared = Rollout(Newtonian(), SAMPLE, free=FREE, jobs=3)
    alone, together = (r.sensitivities(u, first, count, x0) for r in (plain, shared))
    for a, b in zip(alone, together, strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_state_that_blows_up_fills_only_its_own_window(plain):
    x0 = starts(plain)
    x0[1, 1] = 1e300
    good = plain.outputs(commands(), FIRST, COUNT, starts(plain)).y
    y = plain.sensitivities(commands(), FIRST, COUNT, x0).y
    second = slice(COUNT[0], COUNT[0] + COUNT[1])
    assert np.isnan(y[second][-1]).all()
    np.testing.assert_array_equal(np.delete(y, np.r_[second], 0), np.delete(good, np.r_[second], 0))


def test_other_parameters(plain):
    p = plain.model.parameters.values
    p[plain.model.parameters.names.index("k_fvp")] *= 1.1
    x0 = starts(plain)
    changed = Rollout(Newtonian(parameters={"k_fvp": 1.1 * 1.62e-5}), SAMPLE)
    a, b = (r.outputs(commands(), FIRST, COUNT, x0, v) for r, v in ((plain, p), (changed, None)))
    np.testing.assert_allclose(a.y, b.y, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"starts": np.zeros((3, 5))}, "starts"),
        ({"p": np.zeros(3)}, "p has shape"),
        ({"commands": np.zeros((100, 1))}, "commands"),
        ({"count": np.array([30, 45, 50])}, "outside"),
        ({"first": np.array([-1, 0, 0])}, "outside"),
    ],
)
def test_wrong_arrays_never_reach_the_c_code(plain, change, words):
    given = {"commands": commands(), "first": FIRST, "count": COUNT, "starts": starts(plain)}
    with pytest.raises(ValueError, match=words):
        plain.outputs(**(given | change))


class TestDriven:
    """A model whose rotor speeds are prescribed."""

    def test_driven_by_its_own_rotors_it_moves_as_before(self):
        """With the speeds at the middle of each step, to the accuracy of holding them there."""
        base = Newtonian()
        free = Rollout(base, 0.005)
        u = np.tile([1.2, 0.3], (400, 1))
        whole = free.outputs(u, [0], [400], base.rest()[None]).y
        speeds = whole[:, 2:]
        mean = np.vstack([(speeds[:-1] + speeds[1:]) / 2, speeds[-1:]])
        model = DrivenModel(base, ("omega_v", "omega_h"))
        driven = Rollout(model, 0.005)
        y = driven.outputs(np.hstack([u, mean]), [0], [400], model.rest()[None]).y
        assert [s.name for s in model.outputs] == ["alpha_v", "alpha_h"]
        assert np.abs(whole[:, :2] - y).max() < 1e-5
        assert np.ptp(y, axis=0).min() > 0.1

    def test_effects_act_on_it(self):
        base = with_friction_and_delay()
        model = DrivenModel(base, ("omega_v",))
        assert len(Rollout(model, SAMPLE).states) == len(Rollout(base, SAMPLE).states) - 1

    def test_names_that_are_no_measured_states_or_parameters(self):
        with pytest.raises(ModelError, match="no parameter 'k_x'"):
            Rollout(Newtonian(), SAMPLE, free=["k_x"])
        with pytest.raises(ModelError, match="omega_x"):
            DrivenModel(Newtonian(), ("omega_x",))
        with pytest.raises(ModelError, match="left to predict"):
            DrivenModel(Newtonian(), ("alpha_v", "alpha_h", "omega_v", "omega_h"))
