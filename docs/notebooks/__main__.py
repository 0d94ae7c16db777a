"""``python -m docs.notebooks``: execute the tour and the lessons and keep what they show.

Names behind it (``python -m docs.notebooks estimate``) are of the notebooks that are executed.

A cell that raises stops it, and the file stays as it was. Folders named by their time, paths and
timings are taken out of the outputs, so that only what changed in substance changes the file.
"""

from __future__ import annotations

import re
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient

HERE = Path(__file__).parent
#: Folders that hold notebooks.
FOLDERS = (HERE, HERE.parent / "course")
#: What a machine, a day and a clock leave in a text, and what stands for it.
_OWN = (
    (re.compile(r"(?<!\w)(/[\w.-]+)+/outputs/"), "outputs/"),
    (
        re.compile(r"outputs/\d{4}-\d\d-\d\d/\d\d-\d\d-\d\d-([a-z-]+?)(-\d+)?(?=\W)"),
        r"outputs/…-\1",
    ),
    (re.compile(r"\b\d\d-\d\d-\d\d-(?=[a-z])"), "…-"),
    (re.compile(r" at 0x[0-9a-f]+"), ""),
)
_KEPT = ("text/plain", "text/html", "image/png")


def execute(file: Path, folder: Path, *, timeout: int = 600) -> Any:
    """A notebook with the outputs of its cells, run from the first to the last.

    Parameters
    ----------
    file : Path
        The notebook; it is not changed.
    folder : Path
        Where its runs are written.
    timeout : int
        s a cell.

    Raises
    ------
    CellExecutionError
        For the first cell that raises.
    """
    notebook = nbformat.read(file, as_version=4)
    client = NotebookClient(
        notebook, timeout=timeout, kernel_name="python3", resources={"metadata": {"path": folder}}
    )
    return client.execute()


def without_machine(notebook: Any) -> Any:
    """The notebook without what is this machine's, this day's or this clock's."""
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    for number, cell in enumerate(notebook.cells):
        tags = cell.metadata.get("tags")  # a solution is folded by one
        cell.id, cell.metadata = f"cell-{number}", {"tags": tags} if tags else {}
        if cell.cell_type != "code":
            continue
        cell.execution_count = None
        cell.outputs = _joined(cell.outputs)
        for output in cell.outputs:
            if "text" in output:
                output.text = _plain(output.text)
            if "data" in output:
                output.data = {
                    kind: value if kind == "image/png" else _plain(value)
                    for kind, value in output.data.items()
                    if kind in _KEPT
                }
                output.metadata = {}
            if "execution_count" in output:
                output.execution_count = None
    return notebook


def _joined(outputs: list[Any]) -> list[Any]:
    """Outputs with what was printed in one piece: where it is cut is up to the clock."""
    joined: list[Any] = []
    for output in outputs:
        last = joined[-1] if joined else {}
        if output.output_type == "stream" and last.get("name") == output.name:
            last.text += output.text
        else:
            joined.append(output)
    return joined


def _plain(text: str) -> str:
    for pattern, replacement in _OWN:
        text = pattern.sub(replacement, text)
    return text


def notebooks() -> list[Path]:
    """All notebooks of the documentation."""
    return [file for folder in FOLDERS for file in sorted(folder.glob("*.ipynb"))]


def main(names: Sequence[str] = ()) -> int:
    """Execute each notebook, or those that are named, and save it."""
    for file in (file for file in notebooks() if not names or file.stem in names):
        with tempfile.TemporaryDirectory() as folder:
            notebook = without_machine(execute(file, Path(folder)))
        draft = file.with_suffix(".new")
        nbformat.write(notebook, draft)
        draft.replace(file)
        print(f"{file.relative_to(HERE.parent.parent)}: {file.stat().st_size / 1e3:.0f} kB")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
