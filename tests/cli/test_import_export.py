"""`trms import` and `trms export` as they are typed."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.program import Program
from trms_cli.commands import export, import_
from trms_cli.core.errors import ConfigurationError, RecordingError
from trms_cli.recordings.log_reader import read_log
from trms_cli.recordings.read import read_recording

ROWS = "".join(
    f"{k / 50:.3f},{k % 7},{k * 0.09:.2f},1500\n" for k in range(200) if k not in (90, 91)
)
CSV = "# rig: bench\n# loop: open\nt[s],u_v[%],alpha_v[deg],omega_v[rpm]\n" + ROWS


@pytest.fixture
def csv(tmp_path: Path) -> Path:
    path = tmp_path / "lab" / "rec.csv"
    path.parent.mkdir()
    path.write_text(CSV)
    return path


def as_it_was(before: Path, after: Path) -> None:
    """One recording holds what another does."""
    first, second = read_recording(before), read_recording(after)
    np.testing.assert_array_equal(second.time, first.time)
    for name, values in first.channels.items():
        np.testing.assert_array_equal(second.channels[name], values)
    assert second.metadata == first.metadata and second.units == first.units


@pytest.mark.parametrize("ending", ["csv", "mat"])
def test_there_and_back_and_there_again(
    trms: Program, tmp_path: Path, csv: Path, ending: str
) -> None:
    done = trms("import", str(csv))
    assert not done.stderr
    assert "198 samples from 0 to 3.98 s, 50 Hz, 1 gap" in done.stdout
    assert "about 2 samples" in done.stdout
    assert (tmp_path / "rec.mcap").is_file()  # in the working directory, not beside the CSV
    assert [p.name for p in csv.parent.iterdir()] == ["rec.csv"]

    assert not trms("export", "rec.mcap", "--format", ending).stderr
    as_it_was(csv, tmp_path / f"rec.{ending}")
    assert not trms("import", f"rec.{ending}", "--out", "again.mcap").stderr
    as_it_was(csv, tmp_path / "again.mcap")


def test_json_has_the_printed_figures(trms: Program, tmp_path: Path, csv: Path) -> None:
    done = trms("import", str(csv), "--json", "--out", "x.mcap")
    document = json.loads(done.stdout)
    assert document["schema"] == "trms.import/1" and document["samples"] == 198
    assert document["gaps"] == [{"start_s": 1.78, "end_s": 1.84}]
    assert document["channels"]["u_v"]["unit"] == "1"
    assert document["channels"]["u_v"]["quantum"] == pytest.approx(0.01)
    assert document["channels"]["omega_v"]["min"] == pytest.approx(1500 * 2 * np.pi / 60)
    log = read_log(tmp_path / "x.mcap")
    assert log.run["imported"] == "true" and log.run["file_sha256"] == document["sha256"]

    done = trms("export", "x.mcap", "--json", "--out", "x.parquet")
    document = json.loads(done.stdout)
    assert document["format"] == "parquet" and document["complete"] is True
    assert document["topics"]["/command"] == 198 and (tmp_path / "x.parquet").is_file()


def test_a_fault_is_told_with_its_line_and_nothing_is_written(refused, csv: Path) -> None:
    csv.write_text(CSV.replace("0.020,1,", "0.020,one,"))
    refused("import", str(csv), words=["rec.csv:5", "'one'"])


def test_nothing_is_overwritten_unless_forced(trms: Program, tmp_path: Path, csv: Path) -> None:
    out = tmp_path / "rec.mcap"
    out.write_text("mine")
    done = trms("import", str(csv), code=2)
    assert "--force" in done.stderr and out.read_text() == "mine"
    trms("import", str(csv), "--force")
    assert read_log(out).complete


@pytest.mark.parametrize(
    ("module", "argv", "problem"),
    [
        (import_, [], "required: file"),
        (import_, ["a.csv", "--otu", "x"], "'--otu' is not understood; did you mean --out"),
        (import_, ["a.csv", "b.csv"], "'b.csv' is not understood"),
        (import_, ["a.csv", "--out"], "expected one argument"),
        (export, ["a.mcap", "--format", "xml"], "invalid choice: 'xml'"),
    ],
)
def test_wrong_options(module: object, argv: list[str], problem: str) -> None:
    with pytest.raises(ConfigurationError, match=problem) as caught:
        module.main(argv)  # type: ignore[attr-defined]
    assert "--help" in caught.value.remedy


def test_what_is_called_a_log_is_not_imported(trms: Program, tmp_path: Path, csv: Path) -> None:
    trms("import", str(csv), "--out", "x.mcap")
    with pytest.raises(RecordingError, match="log already"):
        import_.main([str(tmp_path / "x.mcap")])
    text = tmp_path / "text.mcap"
    text.write_text("t[s],u_v[V]\n", encoding="utf-8")
    with pytest.raises(RecordingError) as caught:
        import_.main([str(text)])
    assert "log already" not in caught.value.problem


def _renamed(log: Path, trms: Program, tmp_path: Path, name: str, change) -> str:
    """What `trms import` prints of a run's CSV once its header and rows were changed."""
    trms("export", str(log), "--out", "run.csv", "--force")
    lines = (tmp_path / "run.csv").read_text().splitlines()
    rows = [i for i, line in enumerate(lines) if not line.startswith("#")]
    changed = change([lines[i].split(",") for i in rows])
    text = "\n".join([*lines[: rows[0]], *(",".join(row) for row in changed)])
    (tmp_path / f"{name}.csv").write_text(text + "\n")
    return trms("import", f"{name}.csv", "--force").stdout


def test_what_only_a_model_sees_is_told(trms: Program, tmp_path: Path) -> None:
    trms("run", "controller=pid", "ref=square", "sim.duration=25", "out=run")

    def swapped(rows):
        head = rows[0]
        i, j = head.index("alpha_v[rad]"), head.index("alpha_h[rad]")
        head[i], head[j] = head[j], head[i]
        return rows

    def hanging_at_zero(rows):
        i = rows[0].index("alpha_v[rad]")
        return [rows[0], *([*r[:i], str(float(r[i]) + 0.62), *r[i + 1 :]] for r in rows[1:])]

    as_it_is = _renamed(tmp_path / "run", trms, tmp_path, "as_it_is", lambda rows: rows)
    assert "each other's place" not in as_it_is and "off by a constant" not in as_it_is
    assert "alpha_v and alpha_h are in each other's place" in _renamed(
        tmp_path / "run", trms, tmp_path, "swapped", swapped
    )
    assert "as an encoder that was switched on while the beam hung" in _renamed(
        tmp_path / "run", trms, tmp_path, "hanging", hanging_at_zero
    )


@pytest.mark.parametrize("unit", ["grad", "Grad", "grad/s"])
def test_a_unit_with_two_meanings_is_refused(refused, tmp_path: Path, unit: str) -> None:
    path = tmp_path / "rec.csv"
    channel = "omega_v" if unit.endswith("/s") else "alpha_v"
    path.write_text(f"t[s],u_v[V],alpha_h[deg],{channel}[{unit}]\n0,0,1,1\n0.1,0,1,1\n")
    instead = f"{channel}[{unit.lower().replace('grad', 'deg')}]"
    refused("import", str(path), words=["means degrees to some", instead])
