"""A call leaves the process as it found it, wherever it is made."""

import asyncio
import gc
import os
import re
import signal
import sys
import threading
import typing

import pytest

import trms_cli
from tests.program import loaded_by
from trms_cli import TrmsNote, run
from trms_cli.cli import main

SHORT = {"controller": "lqr", "sim": {"duration": 0.5}, "picture": False}


def test_importing_it_loads_nothing(tmp_path):
    loaded = loaded_by("import trms_cli; dir(trms_cli)", tmp_path)
    assert {name for name in loaded if name.partition(".")[0] == "trms_cli"} == {"trms_cli"}
    assert not {"numpy", "hydra", "matplotlib", "pandas"} & loaded


def test_every_name_is_there_documented_and_typed():
    for name in set(trms_cli.__all__) - {"__version__"}:
        found = getattr(trms_cli, name)
        function = found.__call__ if name in ("runs", "stability") else found
        assert function.__doc__ and len(function.__doc__) > 30, name
        if callable(function) and not isinstance(function, type):
            overloaded = name == "options"
            hints = typing.get_type_hints(function) if overloaded else function.__annotations__
            assert "return" in hints, name
            assert "Examples" in function.__doc__ and "Raises" in function.__doc__, name
    assert set(trms_cli.__all__) == set(dir(trms_cli))
    with pytest.raises(AttributeError):
        getattr(trms_cli, "nothing")  # noqa: B009


def state() -> tuple:
    from hydra.core.global_hydra import GlobalHydra

    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    return (
        sys.stdout, sys.stderr, list(sys.path), list(sys.argv), dict(os.environ), os.getcwd(),
        handlers, GlobalHydra.instance().hydra, gc.get_threshold(), threading.active_count(),
    )  # fmt: skip


def test_nothing_of_the_process_is_changed(here):
    run(**SHORT)
    before = state()
    run(**SHORT)
    with pytest.raises(trms_cli.ConfigurationError):
        run(controller="none of these")
    assert state() == before


def test_it_is_quiet_and_can_be_heard(here, capsys):
    quiet = run(**SHORT, out="quiet")
    captured = capsys.readouterr()
    assert captured.out == captured.err == ""
    run(**SHORT, out="loud", verbose=True)
    loud = capsys.readouterr().out
    assert main(["run", "controller=lqr", "sim.duration=0.5", "picture=false", "out=typed"]) == 0
    typed = capsys.readouterr().out

    def steady(text: str) -> list[str]:
        """Without what depends on the machine's speed, and where it is folded."""
        text = re.sub(r"^(time|solver) .*\n( {11}.*\n)*", "", text, flags=re.MULTILINE)
        return text.replace("loud", "typed").replace("quiet", "typed").splitlines()

    assert steady(loud) == steady(typed) == steady(quiet.text)


def test_notes_are_warnings(here, monkeypatch):
    monkeypatch.setattr("trms_cli.core.compilation.compiler", lambda: None)
    monkeypatch.delenv("TRMS_COMPILE", raising=False)
    with pytest.warns(TrmsNote, match="no C compiler"):
        run(**SHORT)


def test_threads_take_turns_and_others_are_not_silenced(here, capsys):
    made: dict[str, object] = {}

    def work(name: str) -> None:
        made[name] = run(**SHORT, seed=len(name), out=name)
        print(f"done {name}")

    threads = [threading.Thread(target=work, args=(name,)) for name in ("a", "bb")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert made["a"].config["seed"] == 1 and made["bb"].config["seed"] == 2
    assert sorted(capsys.readouterr().out.split()) == ["a", "bb", "done", "done"]


def test_it_works_inside_a_running_event_loop_and_beside_a_notebook_s_own_hydra(here):
    import hydra
    from hydra.core.global_hydra import GlobalHydra

    (here / "conf").mkdir()
    (here / "conf" / "mine.yaml").write_text("a: 1\n")

    async def cell():
        return run(**SHORT)

    with hydra.initialize_config_dir(str(here / "conf"), version_base="1.2"):
        mine = GlobalHydra.instance().hydra
        assert asyncio.run(cell()).outcome == "completed"
        assert GlobalHydra.instance().hydra is mine
        assert hydra.compose("mine").a == 1


def test_in_a_notebook_nothing_is_displayed_beside_the_result(here, monkeypatch):
    """Tables that a terminal gets would be displayed past standard output."""
    from trms_cli import stability

    shown: list[object] = []
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    monkeypatch.setattr("rich.jupyter.display", lambda *what: shown.append(what))
    found = stability("equilibria", model="newtonian_vertical", page=False)
    assert not shown and "stability.json" in found.text
