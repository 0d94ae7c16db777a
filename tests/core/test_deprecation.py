"""What is promised goes away slowly (docs/versions.md)."""

import subprocess
import sys

import pytest

from tests.program import in_process
from trms_cli.core import deprecation
from trms_cli.core.deprecation import RENAMED, Renamed, TrmsDeprecationWarning
from trms_cli.models import model

#: As if version 1.1 had given these four their present names.
FORMER = {
    "trms mark": Renamed("trms score", 2),
    "trms score --quotes": Renamed("trms score --json", 2),
    "trms score --former": Renamed("trms score --baseline", 2),
    "sim.length": Renamed("sim.duration", 2),
    "controller=quadratic": Renamed("controller=lqr", 2),
}


@pytest.fixture
def former(monkeypatch):
    for name, renamed in FORMER.items():
        monkeypatch.setitem(RENAMED, name, renamed)


def of_version(number: int, monkeypatch) -> None:
    monkeypatch.setattr(deprecation, "_MAJOR", number)


def test_a_former_name_works_and_says_what_takes_its_place() -> None:
    with pytest.warns(TrmsDeprecationWarning, match=r"model\.Axis is deprecated.*model\.RigAxis"):
        assert model.Axis is model.RigAxis
    with pytest.raises(AttributeError, match="has no attribute 'Axes'"):
        model.Axes  # noqa: B018


def test_the_warning_names_the_line_that_uses_it() -> None:
    with pytest.warns(TrmsDeprecationWarning) as caught:
        model.Axis  # noqa: B018
    assert caught[0].filename == __file__


@pytest.mark.parametrize(
    ("argv", "present", "said"),
    [
        (
            ["mark"],
            ["score"],
            "trms mark is deprecated and goes away with trms 2.0: use trms score",
        ),
        (["score", "a", "--quotes"], ["score", "a", "--json"], "use trms score --json"),
        (["score", "--former=b"], ["score", "--baseline=b"], "trms score --former is deprecated"),
        (["score", "former=b"], ["score", "--baseline=b"], "trms score --former is deprecated"),
        (["mark", "--quotes"], ["score", "--json"], "trms mark is deprecated"),
    ],
)
def test_a_former_word_is_taken_for_the_present_one(argv, present, said, former) -> None:
    with pytest.warns(TrmsDeprecationWarning) as caught:
        assert deprecation.present_words(argv) == present
    assert said in str(caught[0].message)


@pytest.mark.parametrize("argv", [["score", "quotes"], ["run", "--quotes", "former=b"]])
def test_a_file_of_that_name_and_another_commands_option_stay(argv, former, recwarn) -> None:
    assert deprecation.present_words(argv) == argv and not recwarn


@pytest.mark.parametrize(
    ("override", "present"),
    [
        ("sim.length=3", "sim.duration=3"),
        ("+sim.length=3,4", "+sim.duration=3,4"),
        ("controller=quadratic", "controller=lqr"),
        ("controller=pid,quadratic", "controller=pid,lqr"),
        ("sim.lengths=3", "sim.lengths=3"),
        ("out=a/quadratic", "out=a/quadratic"),
        ("name", "name"),
    ],
)
@pytest.mark.filterwarnings("ignore::trms_cli.core.deprecation.TrmsDeprecationWarning")
def test_a_former_key_is_taken_for_the_present_one(override, present, former) -> None:
    assert deprecation.present_override(override) == present


def test_a_run_and_a_sweep_under_former_names_are_the_same(former, tmp_path) -> None:
    with pytest.warns(TrmsDeprecationWarning):
        said = in_process(
            tmp_path, "run", "controller=quadratic", "sim.length=0.5", "picture=false", "out=a"
        ).stdout
        assert said.startswith("run        lqr")
        in_process(tmp_path, "mark", "a", "--quotes")
        said = in_process(
            tmp_path, "run", "-m", "controller=pid,quadratic", "sim.length=0.5", "out=b"
        ).stdout
    assert "lqr" in said and len(list((tmp_path / "b").glob("*/run.mcap"))) == 2


def test_from_its_version_on_it_is_refused_with_the_present_name(
    former, tmp_path, monkeypatch
) -> None:
    of_version(2, monkeypatch)
    for argv, name, present in (
        (["mark", "a"], "trms mark", "trms score"),
        (["score", "a", "--quotes"], "trms score --quotes", "trms score --json"),
        (["run", "sim.length=1"], "sim.length", "sim.duration"),
        (["run", "controller=quadratic"], "controller=quadratic", "controller=lqr"),
    ):
        said = in_process(tmp_path, *argv, code=2).said
        assert f"{name} went away with trms 2.0" in said and f"do use {present}" in said


def test_what_is_renamed_goes_away_in_a_major_version_and_not_at_once() -> None:
    for name, renamed in RENAMED.items():
        assert renamed.gone_with >= 2 and renamed.present not in RENAMED, name


def test_whoever_types_commands_sees_a_line(tmp_path) -> None:
    (tmp_path / "lab").mkdir()
    (tmp_path / "lab" / "__init__.py").write_text("")
    (tmp_path / "lab" / "beam.py").write_text(
        "from trms_cli.models.model import Axis\n"
        "from trms_cli.models.newtonian import Newtonian\n\n\n"
        "class Beam(Newtonian):\n    pass\n"
    )
    (tmp_path / "configs" / "model").mkdir(parents=True)
    (tmp_path / "configs" / "model" / "beam.yaml").write_text("# x\n_target_: lab.beam.Beam\n")
    words = ["run", "--config-dir", "configs", "--allow", "lab", "model=beam", "sim.duration=1"]
    done = subprocess.run(
        [sys.executable, "-m", "trms_cli", *words, "picture=false", "out=run"],
        cwd=tmp_path, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("model.Axis is deprecated and goes away with trms 2.0") == 1
    assert "Traceback" not in done.stderr and "warnings.warn" not in done.stderr
