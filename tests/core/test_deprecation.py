"""What is promised goes away slowly (docs/versions.md)."""

import subprocess
import sys

import pytest

from trms_cli.core.deprecation import TrmsDeprecationWarning
from trms_cli.models import model


def test_a_former_name_works_and_says_what_takes_its_place() -> None:
    with pytest.warns(TrmsDeprecationWarning, match=r"model\.Axis is deprecated.*model\.RigAxis"):
        assert model.Axis is model.RigAxis
    with pytest.raises(AttributeError, match="has no attribute 'Axes'"):
        model.Axes  # noqa: B018


def test_the_warning_names_the_line_that_uses_it() -> None:
    with pytest.warns(TrmsDeprecationWarning) as caught:
        model.Axis  # noqa: B018
    assert caught[0].filename == __file__


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
    assert done.stderr.count("model.Axis is deprecated") == 1
    assert "Traceback" not in done.stderr and "warnings.warn" not in done.stderr
