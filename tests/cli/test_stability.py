"""``trms stability``: what every study has in common, on a small study of a user's own."""

import json
from pathlib import Path

import pytest

STUDY = '''
from dataclasses import dataclass, field

import numpy as np

from trms_cli.core.chart import Axis, Chart, Panel, Points
from trms_cli.core.findings import Findings, Datum, Section, Table
from trms_cli.models.operating_point import operating_point
from trms_cli.models.vector_field import VectorField


@dataclass(frozen=True, kw_only=True)
class Slowest:
    """The slowest mode."""

    at: dict[str, float] = field(default_factory=dict)

    def run(self, subject, tell):
        model = subject.require_equations("the slowest mode")
        subject.require_no_loop("the slowest mode")
        tell("eigenvalues")
        point = operating_point(model, self.at)
        values = np.linalg.eigvals(VectorField(model).linearised(point.x, point.u)[0])
        rows = [[f"<{i}>", Datum(float(v.real), "good"), None] for i, v in enumerate(values)]
        marks = [Points(values.real, values.imag, "eigenvalues", "cross")]
        chart = Chart("plane", [Panel(Axis("Re", "1/s"), Axis("Im", "rad/s"), marks)], "Poles.")
        slowest = float(max(values.real))
        return Findings(
            "Slowest mode",
            [f"It grows by {slowest:.3g} 1/s at {point.words(model)}."],
            [Section("Modes", ["All <b>modes</b>."], [Table(["n", "Re [1/s]", "x"], rows), chart])],
            {"slowest": slowest},
            ["linear only"],
        )
'''


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    configs = tmp_path / "own" / "configs"
    (configs / "study").mkdir(parents=True)
    (configs / "study" / "slowest.yaml").write_text(
        "# the slowest mode\n_target_: slowest.Slowest\nat: {}  # operating point\n"
    )
    (tmp_path / "own" / "slowest.py").write_text(STUDY)
    return configs


def read(folder: Path) -> dict:
    return json.loads((folder / "stability.json").read_text(encoding="utf-8"))


def test_a_study_leaves_sentences_tables_figures_and_numbers(trms, tmp_path, folder):
    result = trms("stability", "--config-dir", str(folder), "study=slowest", "out=found")
    assert "It grows by -0.0467 1/s" in result.stdout and "<0>" in result.stdout
    assert "! linear only" in result.stdout
    found = tmp_path / "found"
    assert {file.name for file in found.iterdir()} == {
        "stability.json", "stability.html", "plane.png"
    }  # fmt: skip
    document = read(found)
    assert document["schema"] == "trms.stability/1" and document["study"] == "slowest"
    assert document["results"]["slowest"] == pytest.approx(-0.0467, abs=1e-4)
    assert document["model"] == "newtonian" and document["loop"] is None
    assert document["tables"][0]["rows"][0] == ["<0>", pytest.approx(-0.0467, abs=1e-3), None]
    assert document["charts"][0]["panels"][0]["marks"][0]["kind"] == "points"
    page = (found / "stability.html").read_text(encoding="utf-8")
    assert "<b>modes" not in page and "&lt;b&gt;modes" in page  # what it shows is escaped
    assert "http:" not in page.replace("http://www.w3.org", "")  # nothing is fetched
    assert "https:" not in page


def test_effects_are_named_and_what_equations_do_not_hold_is_told(trms, tmp_path, folder):
    effects = "effect=[main_reaction_on_yaw,pitch_coulomb_friction]"
    more = (effects, "effect.main_reaction_on_yaw.drag=3e-7", "page=false")
    trms("stability", "--config-dir", str(folder), "study=slowest", "out=found", *more)
    assert [file.name for file in (tmp_path / "found").iterdir()] == ["stability.json"]
    document = read(tmp_path / "found")
    assert document["effects"] == ["main_reaction_on_yaw", "pitch_coulomb_friction"]
    (told,) = [words for words in document["warnings"] if "no part of" in words]
    assert told.startswith("pitch_coulomb_friction: ")


def test_a_sweep_prints_a_line_each(trms, folder):
    argv = ("--config-dir", str(folder), "-m", "launcher.workers=0", "study=slowest")
    result = trms("stability", *argv, "model=newtonian,rahideh")
    lines = [line for line in result.stdout.splitlines() if "It grows" in line]
    assert len(lines) == 2 and "model=rahideh" in lines[1]


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["study.at.alpha_v=1.5"], ["no equilibrium at alpha_v=1.5", "study.at", "closest"]),
        (["study.at.alpa_v=0"], ["'alpa_v'", "study.at.alpa_v", "did you mean alpha_v"]),
        (["model=narx_2dof"], ["sample to sample", "in model", "model=newtonian"]),
        (["controller=lqr"], ["about the model alone", "in controller"]),
        (["controller=lqr", "sim.sample_time=0"], ["0", "sim.sample_time", "above 0 s"]),
        (["out=own"], ["not empty", "in out"]),
        (["page=7"], ["7", "in page", "true or false"]),
        (["study=nothing_such"], ["no option 'nothing_such'", "slowest"]),
        (["++study._target_=slowest.np.array"], ["_target_"]),
    ],
)
def test_bad_requests_are_explained_and_leave_nothing(trms, tmp_path, folder, overrides, words):
    result = trms("stability", "--config-dir", str(folder), "study=slowest", *overrides, code=2)
    assert all(word in result.said for word in words) and len(result.stderr.splitlines()) < 15
    left = [path for path in tmp_path.rglob("*") if path.is_file() and path.suffix != ".pyc"]
    assert {path.name for path in left} == {"slowest.yaml", "slowest.py"}
    assert not list(tmp_path.rglob("*stability"))
