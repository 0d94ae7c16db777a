"""The study of chapter 6: what it reads, that its figures are what was recorded, its page."""

import itertools
import re

import numpy as np
import pytest

from experiments.chapter6.__main__ import PAGE
from experiments.chapter6.decrease import study_decrease
from experiments.chapter6.domain import study_box, study_slice
from experiments.chapter6.iterations import square_wave
from experiments.chapter6.rig import MODEL, Loop, state_at
from experiments.chapter6.settings import settings_table
from experiments.chapter6.study import Mode, read_study
from trms_cli.models.discretisation import discretise


class TestStudy:
    def test_references_stay_within_what_the_rig_can_hold(self):
        loop = Loop(Mode().controller())
        for name, case in read_study().cases.runs.items():
            for signs in itertools.product((-1, 1), repeat=2):
                goal = [
                    reference.get("offset", 0.0) + sign * reference["amplitude"]
                    for reference, sign in zip((case.alpha_v, case.alpha_h), signs, strict=True)
                ]
                target = loop.state.steady_state.solve(np.array(goal))
                assert target.converged and not target.projected, (name, goal)

    def test_six_cases_in_the_thesis_order_of_which_the_quick_one_is_a_part(self):
        full, quick = read_study(), read_study(quick=True)
        kinds = [case.ref for case in full.cases.runs.values()]
        assert kinds == ["square", "sine", "square", "square", "sine", "sawtooth"]
        assert quick.cases.runs == full.cases.runs
        assert set(quick.decrease.only) <= set(full.decrease.modes)
        assert quick.decrease.states < full.decrease.states
        assert quick.domain.slices == full.domain.slices


class TestRig:
    def test_a_state_off_the_target_has_the_rates_it_was_given(self):
        loop = Loop(Mode().controller())
        target = loop.state.steady_state.solve(np.array([0.0, 0.3]))
        offsets = {"alpha_h": 0.4, "rate_v": 0.3, "rate_h": -0.2, "omega_h": 60.0}
        x = state_at(target.x, offsets)
        step = discretise(MODEL, 1e-4).step
        after = np.array(step(x, target.u, MODEL.parameters.values, np.zeros(MODEL.n_w))).ravel()
        assert (after - x)[[5, 2]] / 1e-4 == pytest.approx([0.3, -0.2], abs=1e-3)
        assert state_at(target.x, {}) == pytest.approx(target.x, abs=1e-6)

    def test_stage_costs_add_up_to_the_objective(self):
        # Without a change of mind the costs that are paid are those that were planned.
        loop = Loop(Mode(horizon=30, iterations=60, tolerance=1e-8).controller())
        goal = np.array([0.0, 0.1])
        target = loop.state.steady_state.solve(goal)
        x = state_at(target.x, {"alpha_v": 0.1})
        loop.begin(x, goal, target.u)
        loop.state.newton.plan[:] = target.u[:, None]
        outcome = loop.solve()
        total, before = 0.0, target.u
        for u in loop.state.newton.plan.T:
            after = loop.after(x, u)
            total += loop.stage_cost(x, after, u, before)
            x, before = after, u
        assert total == pytest.approx(outcome.objective, rel=1e-9)

    def test_squares_start_high(self):
        wave = square_wave({"alpha_v": 0.3, "alpha_h": 0.5, "period": 2.0}, 4.0, 0.1)
        assert wave.shape == (40, 2)
        assert wave[0].tolist() == [0.3, 0.5] and wave[10].tolist() == [-0.3, -0.5]


class TestClaims:
    def test_the_objective_falls_by_the_stage_cost_but_for_the_last_move(self):
        study = read_study(quick=True).decrease
        claims, _ = study_decrease(study, seed=77)  # other states than the recorded
        by_mode = {claim.mode: claim for claim in claims}
        assert by_mode["equality"].kept_with_move == 1.0
        assert by_mode["quasi-infinite"].kept == 1.0
        assert by_mode["equality"].shifted < 1e-6  # recursively feasible
        # Without terminal constraint it does not.
        study.only = ["none, N = 12"]
        ((claim,), _) = study_decrease(study, seed=77)
        assert claim.kept < 0.1

    def test_feasible_sets_grow_with_the_horizon_and_with_the_region(self):
        study = read_study(quick=True).domain
        for feasible_states in (study_box(study, seed=3), study_slice(study, "pitch")):
            for terminal in study.terminals:
                sets = [feasible_states.feasible[terminal, horizon] for horizon in study.horizons]
                for smaller, larger in itertools.pairwise(sets):
                    assert not (smaller & ~larger).any()
            for horizon in study.horizons:
                equality = feasible_states.feasible["equality", horizon]
                assert equality.sum() <= feasible_states.feasible["quasi_infinite", horizon].sum()
            assert feasible_states.feasible["equality", study.horizons[-1]].mean() > 0


class TestPage:
    def test_its_tables_are_the_recorded_ones(self, expected):
        text = PAGE.read_text(encoding="utf-8")
        decrease = expected["full"]["decrease"]
        for mode in {name.rpartition("/")[0] for name in decrease}:
            row = next(line for line in text.splitlines() if line.startswith(f"| {mode} |"))
            cells = row.split(" | ")
            assert float(cells[2]) == pytest.approx(100 * decrease[f"{mode}/held"], abs=0.051)
            assert float(cells[3]) == pytest.approx(100 * decrease[f"{mode}/kept"], abs=0.0051)
        for name, value in expected["full"]["cases"].items():
            case, controller, angle, figure = (*name.split("/"), "")[:4]
            if figure == "rmse" and controller == "equality" and angle == "alpha_v":
                assert re.search(
                    rf"^\| {case.replace('_', ' ')} \| equality \| {value:.4f}, ", text, re.M
                )

    def test_what_the_prose_claims(self, expected):
        figures = expected["full"]
        decrease, domain = figures["decrease"], figures["domain"]
        for mode in ("equality", "equality, one iteration", "equality, blocked"):
            assert decrease[f"{mode}/kept_with_move"] == 1.0
        assert decrease["equality/kept"] == 1.0
        assert 0.995 < decrease["equality, rig in finer steps/kept"] < 1.0
        assert decrease["quasi-infinite/kept"] == 1.0
        assert decrease["none, N = 12/kept"] == decrease["none/kept"] == 0.0
        for place in ("box", "angles", "pitch", "yaw"):
            for terminal in ("equality", "quasi_infinite"):
                shares = [domain[f"{place}/{terminal}/{n}"] for n in read_study().domain.horizons]
                assert shares == sorted(shares)
        assert domain["loops/none/6/arrived"] == pytest.approx(2 / 60, abs=1e-6)
        for terminal in ("equality", "quasi_infinite"):
            assert domain[f"loops/{terminal}/6/arrived"] == 1.0
        costs = figures["iterations"]
        for reference in ("square", "fast square"):
            best = costs[f"default/{reference}/40"]
            for iterations in (1, 2, 3):
                assert abs(costs[f"default/{reference}/{iterations}"] / best - 1.0) < 1.5e-4

    def test_the_settings_are_those_of_the_configuration(self):
        """Table 6.1: made of the configuration anew, it is what the page shows."""
        table = settings_table(read_study().cases)
        text = PAGE.read_text(encoding="utf-8")
        assert f"<!-- settings: begin -->\n{table}\n<!-- settings: end -->" in text
        assert "| `controller.prediction_horizon` | 40 | control periods |" in table
        assert "| `controller.preview_horizon` | 0; preview: 20 |" in table
        assert "quasi_infinite (in a region around it), none" in table  # a comment of more lines
