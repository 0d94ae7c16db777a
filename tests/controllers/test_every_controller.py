"""What holds for every controller of the library, whatever its law.

Each is composed by its name in ``configs/controller``. Whatever the estimate and the reference are,
what comes out is a finite command within the limits, a failure names its fall-back, and two runs of
one configuration are equal and share nothing.
"""

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trms_cli.cli import main
from trms_cli.composition.composer import compose
from trms_cli.controllers.controller import Command, Controller, ControlSample, ControlSetup, Status
from trms_cli.core.compilation import BufferedFunction, compiler
from trms_cli.core.trust import allow_export
from trms_cli.library.tasks.experiment import experiment_of
from trms_cli.models.discretisation import discretise
from trms_cli.models.estimate import Estimate
from trms_cli.models.model import Model

FOLDER = Path(__file__).parents[2] / "configs" / "controller"
#: A law that solves linear matrix inequalities at each sample takes its time.
NAMES = [
    pytest.param(name, marks=[pytest.mark.slow] * (name == "robust_mpc"))
    for name in sorted(path.stem for path in FOLDER.glob("*.yaml"))
]
SAMPLES = 8
LEVEL = {"alpha_v": 0.2, "alpha_h": 0.4}


@pytest.fixture(scope="module", params=NAMES)
def made(request: pytest.FixtureRequest, tmp_path_factory: Any) -> tuple[Controller, Model]:
    """A controller and the model that it is composed with."""
    overrides = [f"controller={request.param}"]
    if request.param == "robust_mpc":
        pytest.importorskip("cvxpy")
    if request.param == "played":
        path = tmp_path_factory.mktemp("played") / "u.csv"
        rows = "0.0,1.0,0.5\n0.5,2.0,-0.5\n10.0,0.0,0.0\n"
        path.write_text("t[s],u_v[V],u_h[V]\n" + rows, encoding="utf-8")
        overrides.append(f"controller.u_v.file={path}")
    if request.param == "exported":
        if compiler() is None:
            pytest.skip("needs a C compiler")
        path = tmp_path_factory.mktemp("exported") / "c"
        words = ("controller.prediction_horizon=8", "measure=false", f"out={path}")
        assert main(["export-controller", "newton_mpc", *words]) == 0
        allow_export(path)
        overrides.append(f"controller.folder={path}")
    experiment = experiment_of(compose(overrides).config)
    return experiment.controller, experiment.model


class Runner:
    """A controller under way, fed by hand."""

    def __init__(self, controller: Controller, model: Model) -> None:
        self.controller, self.model = controller, model
        self.setup = ControlSetup(model, controller.sample_time or 0.02, np.zeros(model.n_u))
        self.preview = controller.preview(self.setup)
        self.state: Any = controller.init(self.setup)
        self.u = np.zeros(model.n_u)
        self.time = 0.0
        self.level = np.array([LEVEL[name] for name in model.controlled])

    def sample(
        self, x: np.ndarray, reference: np.ndarray | None = None, w: np.ndarray | None = None
    ) -> ControlSample:
        r = self.level if reference is None else reference
        w = np.zeros(self.model.n_w) if w is None else w
        estimate = Estimate(x.copy(), np.full_like(x, 1e-3), w.copy(), np.full_like(w, 1e-3))
        return ControlSample(self.time, np.tile(r, (self.preview + 1, 1)), estimate, self.u.copy())

    def step(self, *given: np.ndarray, **more: np.ndarray) -> Command:
        sample = self.sample(*given, **more)
        answer = self.controller.step(self.state, sample, want_prediction=True)
        self.check(answer)
        self.u = np.asarray(answer.u, dtype=float).copy()
        self.time += self.setup.sample_time
        return answer

    def check(self, answer: Command) -> None:
        """Finite, within limits, and a failure says what acts instead."""
        lower, upper = self.model.input_bounds()
        assert answer.u.shape == (self.model.n_u,)
        assert np.isfinite(answer.u).all(), answer
        assert np.all(answer.u >= lower) and np.all(answer.u <= upper), answer.u
        if answer.status is Status.FAILED:
            assert answer.fallback and answer.message
        else:
            assert not answer.fallback


class Rig:
    """The model itself, driven by a runner's commands."""

    def __init__(self, runner: Runner) -> None:
        model, period = runner.model, runner.setup.sample_time
        self._step = BufferedFunction(discretise(model, period, max(1, round(period / 0.02))).step)
        self._p, self.runner, self.x = model.parameters.values, runner, model.rest()

    def run(self, samples: int) -> np.ndarray:
        """Commands over so many samples, (samples, n_u)."""
        commands = []
        for _ in range(samples):
            commands.append(self.runner.step(self.x).u.copy())
            w = np.zeros(self.runner.model.n_w)
            self.x = self._step.evaluate(self.x, self.runner.u, self._p, w)[0].copy()
        return np.array(commands)


@pytest.fixture
def rig(made: tuple[Controller, Model]) -> Rig:
    return Rig(Runner(*made))


def follows(rig: Rig) -> bool:
    """Whether the controller looks at estimates and references at all."""
    return getattr(rig.runner.controller, "follows_reference", True)


@pytest.mark.parametrize("first", [True, False], ids=["from the start", "under way"])
def test_what_is_no_number(rig: Rig, first: bool) -> None:
    """It fails as declared, and is over with the first good estimate."""
    runner, still = rig.runner, np.zeros(rig.runner.model.n_w)
    if not first:
        rig.run(3)
    for where, value in ((0, np.nan), (slice(None), np.nan), (-1, np.inf), (0, -np.inf)):
        x = rig.x.copy()
        x[where] = value
        answer = runner.step(x)
        assert answer.status is Status.FAILED or not follows(rig)
    # A law that does not use the disturbance may go on.
    runner.step(rig.x, w=np.full_like(still, np.nan))
    fresh = Runner(runner.controller, runner.model)
    for _ in range(2):
        fresh.u = runner.u.copy()
        answer, expected = runner.step(rig.x), fresh.step(rig.x)
    assert (answer.status is Status.FAILED) == (expected.status is Status.FAILED), answer.message
    # Nor is a reference.
    for _ in range(2):
        answer = rig.runner.step(rig.x, np.full(len(rig.runner.level), np.nan))
        if follows(rig):
            assert answer.status is Status.FAILED
    assert rig.runner.step(rig.x).status is not Status.FAILED


def test_what_is_far_out_of_reach(rig: Rig) -> None:
    # The rig does not move, whatever is asked of it: the commands stay at their limits.
    for _ in range(2 * SAMPLES):
        rig.runner.step(rig.x)
    # A reference beyond what the rig can do.
    rig.run(2)
    for reach in (1.2, -4.0, 1e3, 1e9):
        for _ in range(2):
            rig.runner.step(rig.x, np.full(len(rig.runner.level), reach))
    rig.run(2)
    # An estimate beyond all bounds.
    rig.run(2)
    rng = np.random.default_rng(0)
    for size in (1e3, 1e9, 1e100, 1e300):
        rig.runner.step(size * rng.normal(size=rig.x.shape))
        rig.runner.step(rig.x, w=size * rng.normal(size=rig.runner.model.n_w))
        rig.runner.step(rig.x)


def test_two_runs_are_equal_and_share_nothing(made: tuple[Controller, Model]) -> None:
    """Interleaved with another run, and after one, each bit is as alone; nor is the law changed."""
    before = copy.deepcopy(made[0])
    alone = Rig(Runner(*made)).run(SAMPLES)
    first, other = Rig(Runner(*made)), Rig(Runner(*made))
    other.x = other.x + 0.05
    commands = []
    for _ in range(SAMPLES):
        other.run(1)
        commands.append(first.run(1)[0])
    np.testing.assert_array_equal(np.array(commands), alone)
    np.testing.assert_array_equal(Rig(Runner(*made)).run(SAMPLES), alone)
    assert made[0] == before


def test_what_it_keeps_is_its_own(rig: Rig) -> None:
    """Arrays of a sample may be overwritten after the step; a command may, too."""
    twin = Rig(Runner(rig.runner.controller, rig.runner.model))
    expected = twin.run(4)
    runner, commands = rig.runner, []
    for _ in range(4):
        sample = runner.sample(rig.x)
        estimate = sample.estimate
        answer = runner.controller.step(runner.state, sample, want_prediction=False)
        commands.append(answer.u.copy())
        runner.u, runner.time = answer.u.copy(), runner.time + runner.setup.sample_time
        for array in (sample.reference, sample.previous_command, answer.u):
            array[:] = 77.0
        estimate.x[:] = estimate.disturbance[:] = 77.0
        still = np.zeros(runner.model.n_w)
        rig.x = rig._step.evaluate(rig.x, runner.u, rig._p, still)[0].copy()
    np.testing.assert_array_equal(np.array(commands), expected)
