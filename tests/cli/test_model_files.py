"""``model=fit``: the folder of a fit stands for the model in it."""

import pytest

from trms_cli.composition.composer import compose
from trms_cli.core.errors import ConfigurationError


@pytest.fixture
def fit(tmp_path, monkeypatch):
    """A folder as a fit leaves it, in the present folder."""
    folder = tmp_path / "fit"
    folder.mkdir()
    (folder / "model.yaml").write_text("model: newtonian\n", encoding="utf-8")
    (folder / "identification.json").write_text("{}", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return folder


@pytest.mark.parametrize(
    ("primary", "more"),
    [("run", []), ("excite", []), ("identify", ["real=a.csv"]), ("validate", ["real=a.csv"])],
)
def test_every_command_takes_the_folder_of_a_fit(fit, primary, more):
    for typed in ("fit", "fit/", "'fit'", str(fit), "fit/model.yaml"):
        composition = compose([f"model={typed}", *more], primary)
        assert composition.choices["model"] == "from_file"
        assert composition.config["model"]["path"].endswith("fit/model.yaml")


def test_an_option_is_not_hidden_by_a_folder(fit):
    fit.rename("newtonian")
    assert compose(["model=newtonian"]).choices["model"] == "newtonian"


@pytest.mark.parametrize(
    ("typed", "problem", "remedy"),
    [
        ("fit/identification.json", "not a model file", "did you mean model=fit/model.yaml"),
        ("rig.csv", "not a model file", "a model's YAML"),
        ("empty", "no model.yaml in the folder", "trms identify"),
        ("fti", "no option 'fti'", ""),
    ],
)
def test_what_is_no_model_is_told(fit, typed, problem, remedy):
    fit.with_name("empty").mkdir()
    with pytest.raises(ConfigurationError, match=problem) as caught:
        compose([f"model={typed}"])
    assert remedy in caught.value.remedy
