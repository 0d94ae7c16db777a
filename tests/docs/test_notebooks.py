"""The notebooks run from the first cell to the last, and are kept as they came out.

The lessons of the course end with a task, a cell that checks an answer, and a solution. After the
last cell, in the same kernel, the check is given wrong answers, each of which it has to refuse for
its own reason, and the solution's once more.
"""

import importlib.util
import re
from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat")
pytest.importorskip("nbclient")
pytest.importorskip("ipykernel")

DOCS = Path(__file__).parents[2] / "docs"
FOLDER = DOCS / "notebooks"
LESSONS = sorted((DOCS / "course").glob("*.ipynb"))
NOTEBOOKS = [*sorted(FOLDER.glob("*.ipynb")), *LESSONS]
LARGEST = 600_000  # bytes
#: By lesson: what is handed in, in Python and with the solution's ``answer`` at hand, and why it is
#: refused.
WRONG = {
    "model": [
        ('{n: (value[n], 0.01 * value[n]) for n in SEALED}', "times the noise off"),
        ('answer | {"k_fhp": (1.05 * answer["k_fhp"][0], answer["k_fhp"][1])}', "times the noise"),
        ('{n: (v, 1e-3 * sd) for n, (v, sd) in answer.items()}', "deviations off"),
        ('{n: (v, 0.2 * v) for n, (v, sd) in answer.items()}', "says nothing about"),
        ('{"k_fvp": answer["k_fvp"]}', "give a value and a deviation"),
    ],
    "estimate": [
        ('{"angle": 2e-4, "momentum": 2e-4, "rotor": 3.0}', "surer than it may be"),
        ('{"angle": 2e-4, "momentum": 0.02, "rotor": 0.1}', "surer than it may be"),
        ('{"angle": 2e-4, "momentum": 0.5, "rotor": 3.0}', "S_. is off by"),
        ('{"angle": 2e-4, "momentum": 0.02, "rotor": 60.0}', "omega_. is off by"),
        ('answer | {"rotor": 0.0}', "larger than zero"),
        ('{"momentum": 0.02}', "give angle, momentum and rotor"),
    ],
    "control": [
        ('{"prediction_horizon": 20}', "touches the shelf"),
        ('answer | {"move_weights": {"u_v": 0.02, "u_h": 0.005}}', "V up and down"),
        ('answer | {"move_weights": {"u_v": 0.05, "u_h": 5.0}}', "yaw misses|touches"),
        ('answer | {"prediction_horizon": 40}', "at most 20 periods"),
        ('answer | {"preview_horizon": 10}', "not known ahead"),
    ],
    "diagnose": [
        ('answer | {"effect": "yaw_coulomb_friction"}', "not the effect"),
        ('answer | {"place": "main_motor"}', "does not act at"),
        ('answer | {"size": 1.3 * answer["size"]}', "the size is off by"),
        ('answer | {"uncertainty": 1e-4 * answer["uncertainty"]}', "three of your deviations"),
        ('answer | {"uncertainty": answer["size"]}', "says nothing"),
        ('{"effect": "none"}', "give "),
    ],
}  # fmt: skip


def executing():
    """``docs/notebooks/__main__.py``, whose folder is no package."""
    spec = importlib.util.spec_from_file_location("docs_notebooks", FOLDER / "__main__.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def with_wrong_answers(file: Path, folder: Path) -> tuple[Path, int]:
    """A lesson with cells behind its last that hand in wrong answers, and their number."""
    handed_in = WRONG.get(file.stem, []) if file in LESSONS else []
    notebook = nbformat.read(file, as_version=4)
    for wrong, reason in handed_in:
        notebook.cells.append(nbformat.v4.new_code_cell(
            "import re\ntry:\n"
            f"    accepted = check({wrong})\n"
            "except AssertionError as refused:\n"
            f"    if not re.search({reason!r}, str(refused)):\n"
            "        raise RuntimeError(f'refused for another reason: {refused}') from None\n"
            "else:\n"
            f"    raise RuntimeError(f'{{accepted}}: a wrong answer was accepted')"
        ))  # fmt: skip
    if handed_in:
        notebook.cells.append(nbformat.v4.new_code_cell("assert check(answer).startswith('right')"))
    copy = folder / file.name
    nbformat.write(notebook, copy)
    return copy, len(notebook.cells) - len(nbformat.read(file, as_version=4).cells)


def sources(notebook) -> list[tuple[str, str]]:
    return [(cell.cell_type, cell.source) for cell in notebook.cells]


@pytest.mark.parametrize("file", NOTEBOOKS, ids=lambda file: file.stem)
class TestNotebook:
    @pytest.mark.slow
    def test_runs_and_what_it_claims_holds(self, file, tmp_path, monkeypatch):
        """The claims are asserts in its cells: a cell that raises fails this."""
        monkeypatch.setenv("TRMS_RUNS", str(tmp_path / "index"))
        module = executing()
        copy, more = with_wrong_answers(file, tmp_path)
        made = module.without_machine(module.execute(copy, tmp_path))
        made.cells = made.cells[: len(made.cells) - more]
        kept = nbformat.read(file, as_version=4)
        assert sources(made) == sources(kept)
        for now, before in zip(made.cells, kept.cells, strict=True):
            shown, expected = (
                [output.output_type for output in cell.get("outputs", ())] for cell in (now, before)
            )
            printed = "".join(output.get("text", "") for output in now.get("outputs", ()))
            assert shown == expected, f"{now.source}\n\nprinted:\n{printed}"

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


def test_there_are_a_tour_and_four_lessons():
    assert [file.stem for file in LESSONS] == ["control", "diagnose", "estimate", "model"]
    assert len(NOTEBOOKS) == 5
    assert set(executing().notebooks()) == set(NOTEBOOKS)
    assert WRONG.keys() == {file.stem for file in LESSONS}


@pytest.mark.parametrize("file", LESSONS, ids=lambda file: file.stem)
def test_a_lesson_ends_with_a_task_its_check_and_a_folded_solution(file):
    cells = nbformat.read(file, as_version=4).cells
    task = next(i for i, cell in enumerate(cells) if "## Task" in cell.source)
    check = next(i for i, cell in enumerate(cells) if cell.source.startswith("def check("))
    solution = next(i for i, cell in enumerate(cells) if "### Solution" in cell.source)
    assert task < check < solution < len(cells)
    for cell in cells[solution + 1 :]:
        if cell.cell_type == "code":
            assert cell.metadata.get("tags") == ["hide-cell"]
    assert "check(answer)" in cells[-1].source
    assert "right" in str(cells[-1].outputs[-1])
    # one idea a cell: text before code, and no cell that is a page
    assert sum(cell.cell_type == "markdown" for cell in cells) > len(cells) / 3
    assert max(cell.source.count("\n") for cell in cells) < 60
