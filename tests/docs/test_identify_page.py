"""What ``docs/identify.md`` tells to type, typed; and what it promises of the result."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import pytest

from trms_cli.cli import main

from .markdown import blocks

PAGE = Path(__file__).parents[2] / "docs" / "identify.md"


@pytest.mark.slow
def test_from_a_recording_to_a_model_that_runs(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    count = 0
    for block in blocks(PAGE):
        for command in block.commands if block.language == "sh" else ():
            program, *words = shlex.split(command)
            assert program == "trms"
            code = main(words)
            assert code == 0, f"line {block.line}: {command}\n{capsys.readouterr().err}"
            count += 1
    assert count >= 6
    fit = json.loads(Path("fit/identification.json").read_text(encoding="utf-8"))
    for name, before in fit["errors"]["held_out"]["before"].items():
        assert fit["errors"]["held_out"]["after"][name]["rmse"] < before["rmse"]
    found = {frozenset(entry["names"]) for entry in fit["identifiability"]["confounded"]}
    assert frozenset({"m_cb", "l_cb"}) in found  # as the page says
    for name in ("model.yaml", "identification.html", "config.yaml", "free_runs.png"):
        assert Path("fit", name).is_file()
    search = json.loads(Path("search/identification.json").read_text(encoding="utf-8"))
    assert search["details"]["generations"] == 5
