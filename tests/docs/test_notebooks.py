"""The notebooks run from the first cell to the last, and are kept as they came out."""

import importlib.util
import re
from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat")
pytest.importorskip("nbclient")
pytest.importorskip("ipykernel")

FOLDER = Path(__file__).parents[2] / "docs" / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
LARGEST = 600_000  # bytes


def executing():
    """``docs/notebooks/__main__.py``, whose folder is no package."""
    spec = importlib.util.spec_from_file_location("docs_notebooks", FOLDER / "__main__.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def sources(notebook) -> list[tuple[str, str]]:
    return [(cell.cell_type, cell.source) for cell in notebook.cells]


@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
class TestNotebook:
    @pytest.mark.slow
    def test_runs_and_what_it_claims_holds(self, file, tmp_path, monkeypatch):
        """The claims are asserts in its cells: a cell that raises fails this."""
        monkeypatch.setenv("TRMS_RUNS", str(tmp_path / "index"))
        module = executing()
        made = module.without_machine(module.execute(file, tmp_path))
        kept = nbformat.read(file, as_version=4)
        assert sources(made) == sources(kept)
        shown, expected = (
            [[output.output_type for output in cell.get("outputs", ())] for cell in notebook.cells]
            for notebook in (made, kept)
        )
        assert shown == expected

    def test_is_kept_with_small_outputs_and_nothing_of_a_machine(self, file):
        text = file.read_text(encoding="utf-8")
        assert len(text) <= LARGEST
        assert not re.search(r"/(home|root|tmp|work|Users)/|outputs/\d{4}-", text)
        notebook = nbformat.read(file, as_version=4)
        code = [cell for cell in notebook.cells if cell.cell_type == "code"]
        assert sum(bool(cell.outputs) for cell in code) >= len(code) // 2
        assert all(cell.execution_count is None for cell in code)
        errors = [o for cell in code for o in cell.outputs if o.output_type == "error"]
        assert not errors
        assert max(len(cell.outputs) for cell in code) <= 2  # what is printed, and the value
        assert "assert " in "".join(cell.source for cell in code)


def test_a_cell_that_raises_is_not_passed_over(tmp_path):
    from nbclient.exceptions import CellExecutionError

    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell("assert 1 == 2")])
    nbformat.write(notebook, tmp_path / "wrong.ipynb")
    with pytest.raises(CellExecutionError):
        executing().execute(tmp_path / "wrong.ipynb", tmp_path)


def test_there_is_one():
    assert NOTEBOOKS
