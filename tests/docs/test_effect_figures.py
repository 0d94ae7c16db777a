"""The figures of the effect library: all there, small, drawn without a display."""

from pathlib import Path

import numpy as np
import pytest

from docs.figures.effect_gallery import FIGURES, draw_all
from docs.figures.effect_scenes import SUBSTEPS, library_effect, simulate
from tests.program import loaded_by
from trms_cli.core.resources import config_folder

PNG = b"\x89PNG\r\n\x1a\n"


def test_each_kind_of_effect_has_a_figure():
    options = (config_folder() / "effect").glob("*.yaml")
    shown = {figure.scene.effect: kind for kind, figure in FIGURES.items()}
    classes = {name: type(library_effect(name)) for name in shown}
    assert len(set(classes.values())) == len(FIGURES)
    assert {type(library_effect(path.stem)) for path in options} == set(classes.values())


def test_a_figure_is_small_and_the_same_each_time(tmp_path):
    (first,) = draw_all(tmp_path / "a", ["dead_zone"])
    (second,) = draw_all(tmp_path / "b", ["dead_zone"])
    content = first.read_bytes()
    assert content.startswith(PNG) and 5_000 < len(content) < 60_000
    assert content == second.read_bytes()


@pytest.mark.slow
def test_all_figures_draw(tmp_path):
    for path in draw_all(tmp_path):
        assert path.read_bytes().startswith(PNG)
        assert path.stat().st_size < 60_000


def test_the_scene_simulates_what_the_step_simulates():
    """Torques and arriving commands are read between substeps; the motion may not change by it."""
    from trms_cli.core.compilation import BufferedFunction
    from trms_cli.effects.extended_model import extend_model
    from trms_cli.models.discretisation import discretise
    from trms_cli.models.newtonian import Newtonian

    scene = FIGURES["input_delay"].scene
    effects = {scene.effect: library_effect(scene.effect, scene.sizes)}
    run = simulate(scene, effects)
    model = extend_model(Newtonian(), effects)
    discrete = discretise(model, 0.02, SUBSTEPS)
    step = BufferedFunction(discrete.step)
    x = np.zeros(discrete.n_x)
    x[: model.n_x] = model.rest()
    for u in run.command:
        x = step.evaluate(x, u, model.parameters.values, np.zeros(model.n_w))[0].copy()
    last = [values[-1] for values in run.states.values()]
    np.testing.assert_allclose(x[: model.n_x], last, rtol=1e-9)


def test_the_friction_that_a_scene_reads_off_is_the_friction():
    figure = FIGURES["coulomb_friction"]
    run = simulate(figure.scene, {figure.scene.effect: library_effect(figure.scene.effect)})
    torque = run.torque["alpha_h"]
    assert np.abs(torque).max() == pytest.approx(0.005, rel=5e-3)
    moving = np.abs(np.diff(run.states["alpha_h"])) / 0.02 > 0.02
    assert np.abs(torque[SUBSTEPS - 1 :: SUBSTEPS][moving]).min() == pytest.approx(0.005, rel=5e-3)


def test_no_figure_needs_pyplot():
    code = "import docs.figures.effect_gallery, trms_cli.reporting.style"
    assert "matplotlib.pyplot" not in loaded_by(code, Path(__file__).parents[2])
