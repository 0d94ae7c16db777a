"""The Python of the pages runs, block after block, in a folder with a run of the name it uses.

A page's ``python`` blocks are one session: a name of an earlier block is there in a later one. A
block with ``file=PATH`` is that file; those of ``docs/effects.md`` and ``docs/log-format.md`` have
tests of their own; ``python by-hand=REASON`` is left to the reader.
"""

from pathlib import Path

import pytest

from .markdown import blocks

ROOT = Path(__file__).parents[2]
#: What is tested with more elsewhere.
ELSEWHERE = {"docs/log-format.md"}
#: Folders that the documentation site is made in.
MADE = {"_build", "source"}
#: Pages that fit models and sweep.
LONG = {"docs/library.md", "docs/sweeps.md"}


def _sessions() -> list[str]:
    found = []
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        name = page.relative_to(ROOT).as_posix()
        if MADE.intersection(page.parts):
            continue
        if name not in ELSEWHERE and any(_is_typed(block) for block in blocks(page)):
            found.append(name)
    return found


def _is_typed(block) -> bool:
    typed = block.language == "python" and block.file is None
    return typed and block.by_hand is None


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory) -> Path:
    """A run where the pages say that one is: ``outputs/run.mcap``."""
    from trms_cli import run

    folder = tmp_path_factory.mktemp("python")
    run(controller="newton_mpc", sim={"duration": 1}, picture=False, out=folder / "outputs")
    return folder


def test_there_are_pages_with_python() -> None:
    assert {"docs/library.md", "docs/runs.md", "docs/watch.md"} <= set(_sessions())


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n in LONG else n for n in _sessions()]
)
def test_the_python_of_a_page_runs(name: str, run_folder: Path, monkeypatch, tmp_path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TRMS_RUNS", str(tmp_path / "index"))
    (tmp_path / "outputs").symlink_to(run_folder / "outputs")
    session: dict[str, object] = {"__name__": "__main__"}
    for block in blocks(ROOT / name):
        if _is_typed(block):
            code = "\n" * block.line + block.text  # a traceback names the line of the page
            exec(compile(code, name, "exec"), session)
