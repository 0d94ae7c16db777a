"""The configuration folder is found from a checkout and from a wheel."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).parents[2]


@pytest.mark.slow
def test_a_wheel_carries_every_configuration(tmp_path):
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir"]
    subprocess.run([*pip, str(tmp_path), str(CHECKOUT)], check=True, capture_output=True)
    [wheel] = tmp_path.glob("trms_cli-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "installed")
    code = "from trms_cli.core.resources import config_folder; print(config_folder())"
    found = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(tmp_path / "installed")},
        check=True,
        capture_output=True,
        text=True,
    ).stdout.strip()
    assert found == str(tmp_path / "installed" / "trms_cli" / "configs")
    packed = {file.relative_to(found) for file in Path(found).rglob("*.yaml")}
    source = CHECKOUT / "configs"
    assert packed == {file.relative_to(source) for file in source.rglob("*.yaml")}
