"""Coordinates, demands of thrust and polytopes of robust MPC, against the nonlinear step itself."""

from __future__ import annotations

import numpy as np
import pytest

from experiments.chapter8.judgement import are_inside, independent_cube, remainder
from trms_cli.controllers.robust.polytope import box
from trms_cli.controllers.robust.regulation import Regulation, RegulationDesign
from trms_cli.core.compilation import BufferedFunction
from trms_cli.core.errors import ConfigurationError
from trms_cli.effects.extended_model import extend_model
from trms_cli.effects.input_delay import InputDelay
from trms_cli.models.model import Model
from trms_cli.models.newtonian import Newtonian

from .closed_loop_case import setup_of

BOTH = Newtonian()


def regulation_of(model: Model = BOTH, **design: object) -> Regulation:
    return Regulation(RegulationDesign(**design), setup_of(model))


@pytest.fixture(scope="module")
def regulation() -> Regulation:
    return regulation_of()


def states(model: Model, count: int, seed: int = 0) -> np.ndarray:
    random = np.random.default_rng(seed)
    width = np.array([{"o": 200.0, "S": 1.0, "a": 0.9}[name[0]] for name in model.state_names])
    return random.uniform(-1, 1, (count, model.n_x)) * width


class TestCoordinates:
    def test_the_step_is_the_models_own(self, regulation: Regulation) -> None:
        coordinates = regulation.coordinates
        step = BufferedFunction(coordinates.step)
        plain = BufferedFunction(coordinates.discrete.step)
        w = np.array([0.002, -0.001, 1e-4, -1e-4])
        for x in states(BOTH, 20):
            z = coordinates.forward(x)
            v = np.array([1.3, 0.8 * z[0] + 3000.0])
            u = coordinates.command(x, v, w)
            after = plain.evaluate(x, u, BOTH.parameters.values, w)[0]
            assert coordinates.psi_of(after[:1])[0] == pytest.approx(v[1], abs=0.5)
            found = step.evaluate(z, v, w)[0]
            np.testing.assert_allclose(found, coordinates.forward(after), rtol=1e-5, atol=1e-6)

    def test_a_target_stays(self, regulation: Regulation) -> None:
        step = BufferedFunction(regulation.coordinates.step)
        for reference in ([0.0, 0.0], [0.3, -0.5], [-0.4, 1.0]):
            target = regulation.aim_at(np.array(reference)).target
            after = step.evaluate(target.z, target.v, target.w)[0]
            np.testing.assert_allclose(after, target.z, rtol=1e-6, atol=1e-5)

    def test_the_yaw_is_driven_where_its_rotor_stands_still(self, regulation: Regulation) -> None:
        """In the speed the gain vanishes at standstill; in the thrust it does not."""
        small = regulation.angles(np.full(2, 0.05))
        gains = {}
        for key, one in (("thrust", regulation), ("speed", regulation_of(thrust_inputs=()))):
            aim = one.aim_at(np.zeros(2))
            region = one.region_of(aim.target, np.abs(small) + 0.02)
            coefficients = one.coefficients.over(aim.target, region)
            row = one.coordinates.names.index("dalpha_h")
            gains[key] = coefficients[:, row, 0] / np.abs(coefficients[:, row, 0]).max()
        assert gains["thrust"].min() > 0.6
        assert gains["speed"].min() < 0.1

    def test_fast_states_are_left_out(self) -> None:
        full = regulation_of(Newtonian(currents="dynamic"))
        assert full.n == 6 and not any(name.startswith("i_") for name in full.coordinates.names)

    @pytest.mark.parametrize("freedom", ["vertical", "horizontal"])
    def test_one_axis(self, freedom: str) -> None:
        one = regulation_of(Newtonian(freedom=freedom))
        assert (one.n, one.m) == (3, 1)
        assert bool(one.demands) == (freedom == "horizontal")

    def test_memory_and_unknown_names_are_refused(self) -> None:
        with pytest.raises(ConfigurationError, match="memory"):
            regulation_of(extend_model(BOTH, {"late": InputDelay(rotor="main", delay=0.1)}))
        with pytest.raises(ConfigurationError, match="u_x"):
            regulation_of(thrust_inputs=("u_x",))
        with pytest.raises(ConfigurationError, match="alpha_x"):
            regulation_of(state_weights={"alpha_x": 1.0})


class TestDemand:
    def test_every_demand_within_its_bound_is_within_the_limits(
        self, regulation: Regulation
    ) -> None:
        (demand,) = regulation.demands
        random = np.random.default_rng(1)
        reach = regulation.coordinates.speed_of(np.array([demand.largest]))[0]
        largest = 0.0
        for psi_s in (0.0, 15_000.0, -15_000.0):
            bound = demand.bound(psi_s)
            assert 0 < bound <= demand.scale
            for omega in random.uniform(-0.99, 0.99, 60) * reach:
                x = BOTH.rest()
                x[0] = omega
                psi = regulation.coordinates.psi_of(np.array([omega]))[0]
                for nu in (-bound, bound):
                    v = np.array([0.0, psi_s + demand.pole * (psi - psi_s) + nu])
                    u = regulation.coordinates.command(x, v, np.zeros(4))[1]
                    largest = max(largest, abs(u))
        assert largest <= 2.5 * 1.001
        assert largest > 2.0  # the bound is not idle


class TestPolytope:
    def test_coefficients_give_the_step_exactly(self, regulation: Regulation) -> None:
        aim = regulation.aim_at(np.array([0.1, 0.4]))
        region = regulation.region_of(aim.target, np.full(6, 0.4))
        cube = independent_cube(400, 8, seed=3)
        residual = regulation.coefficients.residual(aim.target, region, cube)
        assert np.median(np.abs(residual)) < 1e-4
        # Rays that cross a standing tail rotor leave something, in yaw and pitch, where
        # the speed has next to no slope in the thrust.
        assert np.abs(residual).max() < 0.02
        across = np.abs(residual).max(axis=1) > 1e-3
        assert across.any()

    def test_other_points_are_inside(self, regulation: Regulation) -> None:
        aim = regulation.aim_at(np.zeros(2))
        region = regulation.region_of(aim.target, np.full(6, 0.4))
        coefficients = regulation.coefficients.over(aim.target, region)
        others = regulation.coefficients.over(aim.target, region, independent_cube(4000, 8, seed=4))
        for components in (2, 3):
            polytope = box(coefficients, components, 0.05)
            assert polytope.vertices == 2**components
            assert are_inside(polytope, others).mean() > 0.99
        tighter = [remainder(box(coefficients, k, 0.05), others).max() for k in (1, 3, 5)]
        assert tighter == sorted(tighter, reverse=True)
        flat = np.concatenate([polytope.A, polytope.B], axis=2)
        assert remainder(polytope, flat).max() < 1e-9  # its own vertices

    def test_a_smaller_region_has_a_smaller_polytope(self, regulation: Regulation) -> None:
        aim = regulation.aim_at(np.zeros(2))
        spreads = []
        for size in (1.0, 0.3, 0.1):
            region = regulation.region_of(aim.target, np.full(6, size))
            spreads.append(np.ptp(regulation.coefficients.over(aim.target, region), axis=0).max())
        assert spreads == sorted(spreads, reverse=True)
        assert spreads[-1] < 0.6 * spreads[0]
