"""The tournament: who takes part, that nothing is lost or run twice, and its verdicts."""

import json
import os
import re
from dataclasses import replace

import msgspec
import pytest

from experiments.tournament import __main__ as program
from experiments.tournament import figures, page, worker_runs
from experiments.tournament.publications import put_beside, read_published
from experiments.tournament.schedule import (
    BLOCKS,
    FAULTS,
    MAIN,
    Run,
    options,
    read_plan,
    rigs_of,
    runs_of,
)
from experiments.tournament.verdict import read_results
from trms_cli.cli import main
from trms_cli.composition.composer import compose
from trms_cli.scoring.comparison.runs import State, gather

PLAN = read_plan()


def a_run(controller="pid", rig="nominal_0", ref="square", words=(), **more):
    """A short run with no observer to be compiled."""
    run = Run(
        controller=controller,
        observer="full_state",
        ref=ref,
        rig=rig,
        rig_class="nominal",
        blocks=(MAIN,),
        entrant_words=(f"controller={controller}", "observer=full_state", *words),
        ref_words=(f"ref={ref}",),
        rig_words=("plant=ideal",),
        every=("sim.duration=2.0", "sim.prediction_every=0"),
    )
    return replace(run, **more)


class TestWhoTakesPart:
    @pytest.mark.parametrize("group", ["controller", "observer", "effect", "fault"])
    def test_every_option_is_entered_or_left_out_with_a_reason(self, group):
        entered = {
            "controller": {*PLAN.controllers},
            "observer": {*PLAN.observers},
            "effect": {r.removeprefix("effect_") for r in rigs_of(PLAN)},
            "fault": {r.removeprefix("fault_") for r in rigs_of(PLAN)},
        }[group]
        exclusions = PLAN.left_out.get(group, {})
        assert all(reason.strip() for reason in exclusions.values())
        missing = set(options(group)) - entered - set(exclusions)
        assert not missing, f"enter them in tournament.yaml, or say why not: {missing}"
        assert not entered & set(exclusions)

    def test_all_in_the_main_block_meet_the_same_conditions(self):
        met: dict[tuple[str, str], set[tuple[str, str]]] = {}
        for run in runs_of(PLAN):
            if MAIN in run.blocks and not run.outside:
                met.setdefault((run.controller, run.observer), set()).add((run.ref, run.rig))
        usual = {name: who for name, who in PLAN.controllers.items() if not who.few}
        whole = [met[name, who.observer] for name, who in usual.items()]
        assert all(conditions == whole[0] for conditions in whole)

    def test_nobody_ranked_sees_the_reference_ahead(self):
        for name, who in PLAN.controllers.items():
            config = compose(["model=newtonian", *who.words]).config["controller"]
            assert not config.get("preview_horizon"), name

    def test_runs_are_unique_and_hundreds_and_the_quick_ones_few_of_every_block(self):
        runs = runs_of(PLAN)
        assert len({run.name for run in runs}) == len(runs)
        assert len(runs) > 600
        quick = runs_of(PLAN, quick=True)
        assert len(quick) < 120
        assert {block for run in quick for block in run.blocks} == set(BLOCKS)

    def test_patterns_choose(self):
        runs = runs_of(PLAN, pattern="pid+ukf/sine/draw_*")
        assert {run.rig for run in runs} == {f"draw_{k}" for k in range(1, 9)}


class TestConfigurations:
    @pytest.mark.parametrize(
        "pick",
        [
            "newton_mpc+ukf/sine/draw_3",
            "lqr+kalman/square/sensors_x4",
            "pid+ukf/square/effect_yaw_coulomb_friction",
            "pid+ukf/square/perfect_sensors",
            "pid+ukf/square/fault_yaw_outliers",
        ],
    )
    def test_joined_parts_are_what_is_composed_at_once(self, pick):
        run = runs_of(PLAN, pattern=pick)[0]
        assert worker_runs.config_of(run) == compose([*run.words, "picture=false"]).config

    def test_parts_that_change_one_key_are_composed_together(self):
        run = a_run(words=("plant.prior_seed=3",))
        config = worker_runs.config_of(run)
        assert config == compose([*run.words, "picture=false"]).config
        assert config["plant"]["prior_seed"] == 3
        assert config["plant"]["sensors"]["noise_sd"]["omega_v"] == 0.0


class TestRunning:
    def test_a_run_without_a_log_scores_as_one_with_it(self, tmp_path):
        worker_runs.perform(a_run(), tmp_path / "a", 60.0, logs=False)
        worker_runs.perform(a_run(), tmp_path / "b", 60.0, logs=True)
        one, other = (gather([tmp_path / name]).runs[0] for name in "ab")
        assert (tmp_path / "b" / MAIN / "pid+full_state/square/nominal_0/run.mcap").is_file()
        assert one.score["channels"] == other.score["channels"]
        assert one.score["inputs"] == other.score["inputs"]
        assert one.coordinates["controller"] == other.coordinates["controller"] == "pid"

    def test_is_filed_in_every_block_and_not_run_twice(self, tmp_path):
        run = a_run(blocks=(MAIN, FAULTS))
        worker_runs.perform(run, tmp_path, 60.0, logs=False)
        for block in run.blocks:
            assert (worker_runs.folder_of(run, tmp_path, block) / "score.json").is_file()
        assert worker_runs.is_done(run, tmp_path)
        assert not worker_runs.is_done(replace(run, ref_words=("ref=sine",)), tmp_path)

    @pytest.mark.parametrize(
        ("run", "limit", "message"),
        [
            (a_run(words=("controller.sample_time=0.03",)), 60.0, "0.03"),
            (
                a_run(every=("sim.duration=2000.0", "sim.prediction_every=0")),
                1.0,
                "longer than 1 s",
            ),
        ],
        ids=["cannot be made", "takes too long"],
    )
    def test_a_failure_is_filed_with_its_sentence(self, tmp_path, run, limit, message):
        worker_runs.perform(run, tmp_path, limit, logs=False)
        filed_run = gather([tmp_path]).runs[0]
        assert filed_run.state is State.FAILED and message in filed_run.message
        assert worker_runs.is_done(run, tmp_path)  # it would fail again

    @pytest.mark.slow
    def test_a_worker_that_dies_is_told_and_takes_nobody_with_it(self, tmp_path, monkeypatch):
        package = tmp_path / "lab"
        (package / "configs" / "controller").mkdir(parents=True)
        (package / "deadly_lab.py").write_text(
            "import os\nfrom tests.library.own_parts import Steady\nclass Deadly(Steady):\n"
            "    def step(self, state, sample, *, want_prediction):\n        os._exit(9)\n"
        )
        (package / "configs" / "controller" / "deadly.yaml").write_text(
            "# kills its process\n_target_: deadly_lab.Deadly\nsample_time: null  # s\n"
        )
        words = ("--config-dir", str(package / "configs"))
        monkeypatch.setenv("TRMS_ALLOW", "deadly_lab")
        deadly = a_run("deadly", every=(*a_run().every, *words))
        runs = [deadly, *(a_run(ref=ref) for ref in ("square", "sine", "sawtooth", "step"))]
        monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(package), os.getcwd()]))
        out = tmp_path / "out"
        ended = list(worker_runs.run_all(runs, out, jobs=2, time_limit=60.0, logs=False))
        assert sorted(run.name for run in ended) == sorted(run.name for run in runs)
        runs_by_controller = {run.coordinates["controller"]: run for run in gather([out]).runs}
        assert runs_by_controller["deadly"].state is State.FAILED
        assert "died" in runs_by_controller["deadly"].message
        assert runs_by_controller["pid"].state is State.DONE
        assert not worker_runs.is_done(deadly, out)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A tournament of three on four rigs, with made-up scores: everything but the runs is real."""
    out = tmp_path_factory.mktemp("finished")
    errors = {"newton_mpc": 0.2, "nmpc": 0.2, "lqr": 0.21}
    for name in ("newton_mpc+ukf/*", "nmpc+ukf/*", "lqr+ukf/*"):
        for run in runs_of(PLAN, pattern=name):
            if run.blocks[0] not in (MAIN, FAULTS):
                continue
            error = errors[run.controller] * (1.5 if run.rig == "draw_2" else 1.0)
            if run.controller == "newton_mpc" and run.rig == "effect_yaw_coulomb_friction":
                error *= 1.2
            milliseconds = 4.0 if run.controller == "nmpc" else 0.5
            score = {
                "schema": "trms.score/1",
                "complete": True,
                "duration_s": 40.0,
                "channels": {n: {"rmse": error / 2} for n in ("alpha_v", "alpha_h")},
                "inputs": {"u_v": {"effort": 1.0, "total_variation": 2.0}},
                "solver": {"time_ms": {"median": milliseconds, "p99": 1.0, "max": 2.0}},
                "constraint_violations": {},
                "run": {"coordinates": run.coordinates, "non_finite": 0, "fingerprint": ""},
            }
            for block in run.blocks:
                folder = worker_runs.folder_of(run, out, block)
                folder.mkdir(parents=True)
                (folder / "score.json").write_text(json.dumps(score))
    return out


class TestVerdicts:
    def test_the_aims_are_judged_by_the_figures(self, finished):
        results = read_results(finished, PLAN.criteria)
        met = {aim.words.split(",")[0]: aim.is_met for aim in results.aims}
        assert [aim.is_met for aim in results.aims] == [True, False, True, True, True], met
        assert {(each.rig, each.ref) for each in results.behind} == {
            ("effect_yaw_coulomb_friction", ref) for ref in PLAN.rigs["effect"].references
        }
        assert results.behind[0].ratio == pytest.approx(0.24 / 0.2)
        assert "8.0 times" in results.aims[-1].figures
        # A tie names one first and tells no difference.
        standings = results.classes["nominal"].standings
        assert [standing.rank for standing in standings] == [1, 2, 3]
        assert standings[1].against_first == pytest.approx(1.0)

    def test_compare_prints_the_same_ranking(self, finished, capsys):
        assert main(["compare", str(finished / MAIN), "--json", "--by", "controller,observer"]) == 0
        compared = json.loads(capsys.readouterr().out)
        results = read_results(finished, PLAN.criteria)
        main_report = page.report(results, [], {}, PLAN.criteria)["main"]
        assert compared == main_report

    def test_is_published_between_the_marks(self, finished, tmp_path):
        results = read_results(finished, PLAN.criteria)
        copy = tmp_path / "tournament.md"
        copy.write_text(page.PAGE.read_text(encoding="utf-8"), encoding="utf-8")
        about = {"seconds": 60.0, "jobs": 2, "whole": False, "git": "",
                 "machine": {"processor": "x", "cores": 2, "python": "3.11"}}  # fmt: skip
        tables = page.tables(results, [], PLAN.criteria)
        drawn = figures.draw(results, tmp_path / "drawn")
        assert [path.name for path in drawn] == list(figures.NAMES)
        assert all(path.stat().st_size > 5000 for path in drawn)
        place = copy.parent / "figures" / "tournament"
        page.publish({**tables, "observers": ["–"]}, about, results, drawn, copy, place)
        text = copy.read_text(encoding="utf-8")
        assert "| 1 | nmpc + ukf |" in text  # the same but for one rig
        assert "Only a part" in text
        again = text.count("made:")
        links = re.findall(r"\]\((figures/[^)]*)\)", text)
        assert len(links) == len(drawn)
        assert all((tmp_path / link).is_file() for link in links)
        page.publish({**tables, "observers": ["–"]}, about, results, drawn, copy, place)
        assert copy.read_text(encoding="utf-8").count("made:") == again


class TestProgram:
    def test_runs_resumes_and_refuses_what_it_cannot(self, tmp_path, capsys, monkeypatch):
        # what of ours is put beside published figures is run in a test of its own
        alone = [each for each in read_published() if each.ours is None]
        monkeypatch.setattr("experiments.tournament.publications.read_published", lambda: alone)
        words = ["--only", "pid+ukf/*/nominal_0", "--quick"]
        words += ["--jobs", "1", "--out", str(tmp_path / "t")]
        assert program.main(words) == 0
        report = json.loads((tmp_path / "t" / "report.json").read_text(encoding="utf-8"))
        assert report["schema"] == "trms.tournament/1"
        assert report["runs"] == 2
        assert program.main(words) == 2
        assert "--resume" in capsys.readouterr().err
        score = next((tmp_path / "t" / MAIN).rglob("score.json"))
        before = score.stat().st_mtime_ns
        assert program.main([*words, "--resume"]) == 0
        assert score.stat().st_mtime_ns == before
        assert program.main(["--only", "x", "--out", str(tmp_path)]) == 2
        assert "no run matches" in capsys.readouterr().err


def test_published_figures_have_sources_and_ours_can_be_run(tmp_path):
    published = read_published()
    assert all(each.author and each.condition and each.theirs for each in published)
    ours = next(each for each in published if each.ours is not None and each.ours.limits)
    short = [w for w in ours.ours.words if not w.startswith("sim.duration")] + ["sim.duration=2.0"]
    shorter = msgspec.structs.replace(ours, ours=msgspec.structs.replace(ours.ours, words=short))
    beside = put_beside(shorter, tmp_path)
    assert not beside.problem
    assert len(beside.figures) == len(ours.ours.figures)
