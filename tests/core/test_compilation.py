"""Compiled functions: equal to interpreted ones, cached by content, optional."""

import stat
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

from trms_cli.core import compilation
from trms_cli.core.compilation import BufferedFunction, compile_function


@pytest.fixture(name="cache")
def _cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TRMS_CACHE", str(tmp_path / "cache"))
    for name in ("TRMS_COMPILE", "TRMS_CFLAGS"):
        monkeypatch.delenv(name, raising=False)
    compilation.compiler.cache_clear()
    yield tmp_path / "cache"
    compilation.compiler.cache_clear()


def function(factor: float = 2.0) -> ca.Function:
    x, y = ca.SX.sym("x", 3), ca.SX.sym("y", 2, 2)
    return ca.Function(
        "sample", [x, y], [factor * ca.sin(x), ca.mtimes(y, y), ca.jacobian(x**2, x)]
    )


def test_compiled_equals_interpreted_in_arrays_that_stay_and_may_be_shared(cache: Path) -> None:
    arguments = [np.array([0.1, 0.2, 0.3]), np.array([[1.0, 2.0], [3.0, 4.0]])]
    fast = BufferedFunction(function()).evaluate(*arguments)
    slow = BufferedFunction(function(), compile=False).evaluate(*arguments)
    for one, other in zip(fast, slow, strict=True):
        assert one == pytest.approx(other, rel=1e-15)
    assert fast[1] == pytest.approx(arguments[1] @ arguments[1])
    assert fast[2] == pytest.approx(np.diag(2 * arguments[0]))
    first = BufferedFunction(function(2.0))
    second = BufferedFunction(function(3.0), inputs=first.inputs)
    first.inputs[0][:] = 0.5
    first()
    second()
    assert second.outputs[0] == pytest.approx(1.5 * first.outputs[0])
    assert second.inputs[0] is first.inputs[0]


def test_cache_is_by_content_in_another_process_too(cache: Path) -> None:
    compile_function(function(2.0))
    compile_function(function(2.0))
    code = "from tests.core.test_compilation import *; compile_function(function(2.0))"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2])
    assert len(list(cache.glob("*.so"))) == 1
    compile_function(function(3.0))
    assert len(list(cache.glob("*.so"))) == 2
    assert not [path for path in cache.iterdir() if path.suffix != ".so"]


def test_any_level_of_optimisation_gives_the_same_numbers(cache, monkeypatch) -> None:
    values = []
    for flags in ("", "-O0", "-O3 -g"):
        monkeypatch.setenv("TRMS_CFLAGS", flags)
        compilation._loaded.cache_clear()
        outputs = BufferedFunction(function(0.3)).evaluate(np.arange(1.0, 4.0), np.eye(2))
        values.append([output.tobytes() for output in outputs])
    assert values[0] == values[1] == values[2]
    assert len(list(cache.glob("*.so"))) == 3


@pytest.mark.parametrize("trouble", ["no compiler", "a broken compiler", "no place for a cache"])
def test_trouble_costs_speed_and_not_the_run(trouble, cache, tmp_path, monkeypatch) -> None:
    broken = tmp_path / "cc"
    broken.write_text("#!/bin/sh\nexit 1\n")
    broken.chmod(broken.stat().st_mode | stat.S_IXUSR)
    name, value = {
        "no compiler": ("TRMS_COMPILE", "0"),
        "a broken compiler": ("CC", str(broken)),
        "no place for a cache": ("TRMS_CACHE", str(broken / "below")),
    }[trouble]
    monkeypatch.setenv(name, value)
    compilation.compiler.cache_clear()
    assert (compilation.compiler() is None) == (trouble == "no compiler")
    found = BufferedFunction(function()).evaluate(np.ones(3), np.eye(2))[0]
    assert found == pytest.approx(2 * np.sin(np.ones(3)))
    assert not list(cache.glob("*"))


def test_a_long_compilation_is_told_at_a_terminal_alone(cache, tmp_path, monkeypatch) -> None:
    """A compiler that takes long stands in for a large function."""
    slow = tmp_path / "slow_cc"
    slow.write_text(f'#!/bin/sh\nsleep 0.5\nexec {compilation.compiler()} "$@"\n')
    slow.chmod(0o755)
    monkeypatch.setenv("CC", str(slow))
    compilation.compiler.cache_clear()
    monkeypatch.setattr(compilation, "_LONG", 0.05)
    said: list[str] = []
    for is_terminal, expected in ((False, 0), (True, 1)):
        terminal = SimpleNamespace(isatty=lambda answer=is_terminal: answer, write=said.append)
        monkeypatch.setattr(compilation.sys, "stderr", terminal)
        source = f"double value_{is_terminal}(void) {{ return 1.0; }}\n"
        assert compilation.compiled_source(f"value_{is_terminal}", source) is not None
        assert len(said) == expected
    assert "compiling value_True" in said[0] and str(cache) in said[0]
