"""The pages on recordings and excitation: what they tell to type works and says what they show."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from .markdown import blocks
from .test_docs import ROOT, says, typed

PAGES = ("docs/recordings.md", "docs/excitation.md")


@pytest.mark.parametrize("name", PAGES)
def test_what_the_page_tells_to_type_works(name: str, tmp_path: Path) -> None:
    count = 0
    for block in blocks(ROOT / name):
        place = f"{name}, line {block.line}"
        if block.file is not None:
            (tmp_path / block.file).write_text(block.text, encoding="utf-8")
        elif block.language == "sh" and "by-hand" not in block.words:
            for command in block.commands:
                done = typed(command, tmp_path)
                assert done.returncode == 0, f"{place}: {command}\n{done.stdout}{done.stderr}"
                count += 1
        elif block.language == "console":
            first, _, expected = block.text.partition("\n")
            done = typed(first.removeprefix("$ "), tmp_path)
            output = done.stdout + done.stderr
            assert says(expected, output), f"{place}\n{output}"
            count += 1
    assert count >= 1


@pytest.mark.slow
def test_the_table_of_excitations_is_what_the_program_says(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "excitation.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \|", page, re.M)
    assert len(rows) == 4
    for kind, *numbers in rows:
        done = typed(f"trms excite excitation={kind} rigs=0 picture=false out={kind}", tmp_path)
        assert done.returncode == 0, done.stderr
        inputs = json.loads((tmp_path / kind / "excitation.json").read_text())["inputs"]
        measured = [inputs[n][k] for n in ("u_v", "u_h") for k in ("amplitude", "crest_factor")]
        assert measured == pytest.approx([float(n) for n in numbers], rel=0.02), kind
