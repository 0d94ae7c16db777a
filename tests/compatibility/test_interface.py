"""What version 1 promises is there, or works on with a warning (docs/versions.md)."""

import warnings

import pytest

import trms_cli
from tests.compatibility import interface
from tests.compatibility.interface import gone, promised, renew
from trms_cli.core.deprecation import RENAMED, Renamed

#: Kinds whose fields are read off a run rather than off the code.
MEASURED = ("field", "topic")


def check(names: set[str], before: set[str]) -> None:
    lost = gone(names, before)
    assert not lost, (
        "promised, and gone: let them work with a warning (trms_cli/core/deprecation.py), "
        f"docs/versions.md has the rule\n{chr(10).join(lost)}"
    )
    if new := names - before:
        warnings.warn(
            f"new and not yet promised: `make interface` adds {sorted(new)}", stacklevel=1
        )


def kinds(names: set[str], measured: bool) -> set[str]:
    static = {
        name for name in names if name.startswith(("field trms.diagnosis/", "field trms.inv"))
    }
    return {
        name
        for name in names
        if (name.partition(" ")[0] in MEASURED and name not in static) is measured
    }


def test_the_inventory_is_of_this_major_version_and_whole():
    version, names = promised()
    assert version.split(".")[0] == trms_cli.__version__.split(".")[0]
    assert {"command run", "option score --json", "key run sim.duration", "choice controller=lqr",
            "key controller=newton_mpc preview_horizon", "field trms.score/1 channels.alpha_v.rmse",
            "field trms.diagnosis/1 causes.[].probability", "field /command u_v",
            "python trms_cli.run(controller)"} <= names  # fmt: skip


def test_commands_options_keys_and_python_are_those_that_were_promised():
    _, before = promised()
    check(interface.static_names(), kinds(before, measured=False))


@pytest.mark.slow
def test_documents_and_logs_have_the_fields_that_were_promised():
    _, before = promised()
    check(interface.measured_names(), kinds(before, measured=True))


@pytest.fixture
def file(tmp_path, monkeypatch):
    """An inventory of a small program."""
    monkeypatch.setattr(trms_cli, "__version__", "1.2.0")
    renew({"command run", "key controller=pid gain"}, tmp_path / "interface.txt")
    return tmp_path / "interface.txt"


def test_what_is_new_is_added(file):
    assert renew({"command run", "command fly", "key controller=pid gain"}, file) == []
    version, names = promised(file)
    assert version == "1.2.0" and {"command run", "command fly"} < names


def test_what_is_gone_is_told_and_stays_promised(file):
    before = file.read_bytes()
    assert renew({"command run", "command fly"}, file) == ["key controller=pid gain"]
    assert file.read_bytes() == before
    with pytest.raises(AssertionError, match=r"promised, and gone(.|\n)*pid gain"):
        check({"command run"}, promised(file)[1])


@pytest.mark.parametrize(
    ("line", "former"),
    [
        ("key controller=pid gain", "controller.gain"),
        ("key run sim.length", "sim.length"),
        ("command mark", "trms mark"),
        ("option score --quotes", "trms score --quotes"),
        ("choice controller=quadratic", "controller=quadratic"),
    ],
)
def test_what_works_on_under_its_former_name_is_not_gone(line, former, monkeypatch):
    assert gone(set(), {line}) == [line]
    monkeypatch.setitem(RENAMED, former, Renamed("another", 2))
    assert gone(set(), {line}) == []


def test_a_deprecated_python_name_is_not_gone():
    lines = {"python trms_cli.models.model.Axis", "python trms_cli.models.model.Axes"}
    assert gone(set(), lines) == ["python trms_cli.models.model.Axes"]


def test_a_major_version_may_leave_names_out(file, monkeypatch):
    monkeypatch.setattr(trms_cli, "__version__", "2.0.0")
    assert renew({"command run"}, file) == []
    assert promised(file) == ("2.0.0", {"command run"})
