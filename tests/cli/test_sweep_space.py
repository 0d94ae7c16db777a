"""What is typed after -m becomes choices, ranges and priors; what cannot be is explained."""

from pathlib import Path

import pytest

from trms_cli.composition.composer import compose
from trms_cli.composition.overrides import read_request
from trms_cli.composition.sweep_space import first_of, space_of
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.plugins import build
from trms_cli.models.parameters import DRAW_LIMIT_SD
from trms_cli.sweeps.space import Choice, PriorOfKey, Range, Space


def space(*words: str) -> Space:
    return space_of(read_request(words), "run")


class TestChoices:
    @pytest.mark.parametrize(
        ("word", "values"),
        [
            ("controller=pid,lqr", ("pid", "lqr")),
            ("controller=choice(pid,lqr)", ("pid", "lqr")),
            ("seed=range(3)", ("0", "1", "2")),
            ("seed=sort(3,1,2)", ("1", "2", "3")),
            ("sim.duration=range(0.1,0.5,0.1)", ("0.1", "0.2", "0.3", "0.4")),
            ("signal@ref.alpha_v=sine,square", ("sine", "square")),
            (
                "effect=[],main_dead_zone,[main_dead_zone,tail_dead_zone]",
                ("[]", "main_dead_zone", "[main_dead_zone,tail_dead_zone]"),
            ),
            ("effect=glob(*_dead_zone)", ("main_dead_zone", "tail_dead_zone")),
            ("plant.initial={alpha_h:0.1},{alpha_h:0.2}", ("{alpha_h:0.1}", "{alpha_h:0.2}")),
            ("controller.sample_time=null,0.1", ("null", "0.1")),
            ("seed=1,2,1,1", ("1", "2")),
            ("seed=1,1,1", ("1",)),
            ("controller=pid,lqr,pid", ("pid", "lqr")),
            ("controller=pid,pid", ("pid",)),
        ],
    )
    def test_values_stand_as_they_would_be_typed(self, word, values):
        found = space("ref=square", word)
        assert found == Space(("ref=square",), (Choice(word.partition("=")[0], values),))

    def test_paths_are_choices(self, tmp_path: Path):
        files = [tmp_path / "a model.yaml", tmp_path / "b(2).yaml"]
        for file in files:
            file.write_text("name: fit\nmodel: newtonian\nparameters: {}\n")
        [choice] = space(f"model={files[0]},{files[1].rename(tmp_path / 'b.yaml')}").choices
        assert choice.values == (str(files[0]), str(tmp_path / "b.yaml"))

    def test_shuffling_is_the_same_each_time(self):
        first, again = (space("seed=shuffle(range(50))").choices[0].values for _ in range(2))
        assert first == again != tuple(map(str, range(50)))
        assert sorted(map(int, first)) == list(range(50))

    def test_a_list_is_one_value_and_what_is_typed_last_counts(self):
        found = space("effect=[main_dead_zone,tail_dead_zone]", "controller.move_blocks=[1,2,3]")
        assert not found.choices and len(found.fixed) == 2
        assert space("seed=1,2", "seed=3") == Space(("seed=3",), ())

    def test_every_run_composes(self):
        found = space("controller=pid,lqr", "plant.parameters.k_g=0.1,0.2", "model=newtonian")
        assert compose(first_of(found)).config["plant"]["parameters"] == {"k_g": 0.1}


class TestRanges:
    def test_bounds_scale_and_present_value(self):
        key = "controller.state_weights.alpha_v"
        [found] = space(f"{key}=tag(log,interval(0.1,10))").continuous
        assert found == Range(key, 0.1, 10.0, logarithmic=True, now=1.2)
        [without] = space("plant.parameters.k_g=interval(0.01,0.02)").continuous
        assert isinstance(without, Range) and without.now is None

    @pytest.mark.parametrize(
        ("word", "whole"),
        [
            ("controller.max_iterations=interval(1,5)", True),
            ("controller.max_iterations=interval(1.0,5)", False),
            ("controller.state_weights.alpha_v=interval(1,5)", False),
            ("plant.parameters.k_g=interval(0,1)", True),
            ("seed=interval(0,1000)", True),
        ],
    )
    def test_whole_numbers(self, word, whole):
        [found] = space(word).continuous
        assert isinstance(found, Range) and found.whole is whole


class TestPriors:
    def test_of_one_parameter(self):
        [found] = space("plant.parameters.k_g=prior").continuous
        assert isinstance(found, PriorOfKey)
        assert (found.mean, found.sd) == (0.0123, pytest.approx(0.3 * 0.0123))
        assert found.low == pytest.approx(0.0123 * (1 - 0.3 * DRAW_LIMIT_SD))
        [wider] = space("plant.parameters.k_g=prior", "plant.prior_scale=2").continuous
        assert isinstance(wider, PriorOfKey) and wider.sd == pytest.approx(2 * found.sd)

    def test_of_all_that_have_one_and_no_value(self):
        given = ("plant.parameters.k_g=0.05", "plant.parameters.R=interval(7,9)")
        found = space("plant.parameters=prior", *given)
        table = build(compose([]).config["model"], "model").parameters
        expected = {p.name for p in table if p.prior_sd} - {"k_g"}
        assert {v.key.removeprefix("plant.parameters.") for v in found.continuous} == expected
        assert found.fixed == ("plant.parameters.k_g=0.05",)

    def test_of_the_model_and_of_effects(self):
        assert space("model.parameters.k_g=prior").continuous[0].key == "model.parameters.k_g"
        found = space("effect=yaw_stribeck_friction", "effect.yaw_stribeck_friction=prior")
        sizes = [v.key.rpartition(".")[2] for v in found.continuous]
        assert sizes == ["torque", "excess", "velocity"]
        key = "effect.yaw_coulomb_friction.torque"
        [one] = space("effect=yaw_coulomb_friction", f"{key}=prior").continuous
        assert one == Range(key, 0.002, 0.02, logarithmic=True)

    def test_all_runs_see_the_same_draws(self):
        assert space("plant.parameters=prior", "controller=pid,lqr").choices
        with pytest.raises(ConfigurationError, match="others under model=lagrangian"):
            space("plant.parameters=prior", "model=newtonian,lagrangian")
        words = ["plant.parameters=prior", "model=newtonian,lagrangian"]
        assert len(space(*words, "model@plant.model=newtonian").continuous) == 25


@pytest.mark.parametrize(
    ("words", "where", "told"),
    [
        (["controller=pdi,lqr"], "controller", "did you mean pid"),
        (["controler=pid,lqr"], "controler", "did you mean controller"),
        (["controller.state_weigths.alpha_v=interval(1,2)"], "controller.state", "state_weights"),
        (["controller.max_iterations=interval(5,1)"], "controller.max_iterations", "LOW below"),
        (["seed=tag(log,interval(0,9))"], "seed", "above zero"),
        (["seed=tag(lg,interval(1,9))"], "seed", "tag(log,"),
        (["seed=interval(1)"], "seed", ""),
        (["effect=glob(nothing*)"], "effect", "trms list effect"),
        (["seed=prior"], "seed", "seed=interval(LOW,HIGH)"),
        (["plant.parameters.kg=prior"], "plant.parameters.kg", "did you mean k_g"),
        (["plant.parameters.m_t=prior"], "plant.parameters.m_t", "interval(LOW,HIGH) in kg"),
        (["plant.parameters.k_g=prior,0.1"], "plant.parameters.k_g", "=prior alone"),
        (["effect.main_dead_zone=prior"], "effect.main_dead_zone", "effect=main_dead_zone"),
        (["hydra/sweeper=optuna"], "hydra/sweeper", "sampler="),
    ],
)
def test_bad_input_names_the_key_and_what_to_write(words, where, told):
    with pytest.raises(ConfigurationError) as caught:
        space(*words)
    assert caught.value.where.startswith(where)
    assert told in caught.value.remedy
