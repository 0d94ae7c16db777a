"""The worked rigs: what their pages tell to type works, in a copy of their folder."""

import json
import shutil
from pathlib import Path

import pytest

from tests.docs.test_docs import ROOT, type_page


@pytest.mark.slow
@pytest.mark.parametrize(
    ("example", "cause"),
    [("servo_drive", "carriage_coulomb_friction"), ("cart_pole", "cart_coulomb_friction")],
)
def test_a_worked_rig_is_diagnosed_as_its_page_tells(example, cause, tmp_path: Path) -> None:
    source = ROOT / "examples" / example
    leave = shutil.ignore_patterns("__pycache__", "outputs", ".pytest_cache")
    shutil.copytree(source, tmp_path, ignore=leave, dirs_exist_ok=True)
    assert type_page(f"examples/{example}/README.md", tmp_path, str) >= 6
    document = json.loads((tmp_path / "outputs/diagnosis/diagnosis.json").read_text("utf-8"))
    assert document["causes"][0]["effects"] == [cause]
    assert document["causes"][0]["probability"] > 0.8
