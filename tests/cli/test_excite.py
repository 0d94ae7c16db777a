"""``trms excite`` as a person meets it: its files, its words, and the run that plays it."""

import json
from pathlib import Path

import numpy as np
import pytest

from trms_cli.cli import main
from trms_cli.identification.excitation.findings import findings
from trms_cli.recordings.log_reader import read_log

QUICK = ("duration=20", "lead_in=5", "rigs=1", "excitation=prbs", "band.lowest=0.1")


@pytest.fixture(scope="module")
def designed(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("excite") / "there"
    assert main(["excite", *QUICK, f"out={folder}"]) == 0
    return folder


def test_it_leaves_a_table_a_document_and_a_picture(designed):
    document = json.loads((designed / "excitation.json").read_text())
    assert document["schema"] == "trms.excitation/1"
    assert document["kind"] == "prbs" and document["band_hz"][0] == 0.1
    lines = (designed / "excitation.csv").read_text().splitlines()
    header = next(line for line in lines if not line.startswith("#"))
    assert header == "t[s],u_v[V],u_h[V]"
    rows = np.loadtxt(designed / "excitation.csv", delimiter=",", skiprows=lines.index(header) + 1)
    assert rows.shape == (1250, 3)
    figures = document["inputs"]["u_v"]
    assert np.ptp(rows[250:, 1]) == pytest.approx(2 * figures["amplitude"], rel=1e-4)
    assert (designed / "excitation.png").read_bytes().startswith(b"\x89PNG")


def test_its_page_begins_with_figures(designed):
    document = json.loads((designed / "excitation.json").read_text())
    labels = [measure.label for measure in findings(document).measures]
    assert labels == ["excitation", "pitch", "yaw", "over the noise", "reach a stop"]
    page = (designed / "excitation.html").read_text()
    assert page.index("range simulated") < page.index("of lead-in")


def test_the_run_goes_where_it_was_predicted(designed, trms, tmp_path):
    table = designed / "excitation.csv"
    words = ("controller=played", f"controller.u_v.file={table}", "sim.duration=25", "out=run")
    trms("run", *words, "observer=full_state", "plant=ideal", "picture=false")
    document = json.loads((designed / "excitation.json").read_text())
    state = read_log(tmp_path / "run" / "run.mcap").tables["/plant/state"].columns
    for name in ("alpha_v", "alpha_h", "omega_v", "omega_h"):
        low, high = document["predicted"][name]["range"]
        seen = np.asarray(state[name], dtype=float)[250:]
        assert seen.min() == pytest.approx(low, abs=0.01 * (high - low))
        assert seen.max() == pytest.approx(high, abs=0.01 * (high - low))


def test_the_printed_command_plays_it(trms):
    done = trms("excite", *QUICK, "picture=false", "model=newtonian_vertical")
    line = next(line for line in done.stdout.splitlines() if line.startswith("next"))
    words = line.split(" run ", 1)[1].split()
    assert "model=newtonian_vertical" in words and "controller=open_loop" in words
    trms("run", *words, "observer=full_state", "plant=ideal", "picture=false")


@pytest.mark.parametrize(
    ("override", "where"),
    [
        ("duration=-1", "duration"),
        ("share=2", "share"),
        ("excitation=prbz", "excitation"),
        ("band.highest=100", "band.highest"),
        ("band.lowest=abc", "lowest"),
        ("operating_point={alpha_v: 2}", "operating_point.alpha_v"),
        ("amplitude={u_x: 1}", "amplitude.u_x"),
        ("amplitude.u_v=50", "amplitude.u_v"),
        ("bounds.alpha_x=1", "bounds.alpha_x"),
        ("sample_time=1e-9", "duration"),
    ],
)
def test_slips_are_told_by_their_key(override, where, refused):
    refused("excite", *QUICK, override, words=where)


def test_a_duration_without_a_period_is_told(refused):
    refused("excite", "duration=0.5", words=["in duration", "a longer duration"])


def test_a_rotor_alone_is_limited_by_its_command(tmp_path, capsys):
    """A speed has no stop."""
    words = ["model=motor_main", "duration=40", "lead_in=2", "rigs=1", "share=0.6"]
    assert main(["excite", *words, f"out={tmp_path / 'x'}"]) == 0
    document = json.loads((tmp_path / "x/excitation.json").read_text(encoding="utf-8"))
    motor = document["inputs"]["u_v"]
    assert motor["amplitude"] == pytest.approx(0.6 * motor["limit"])
    assert document["bounds_rad"] == {}
    assert max(document["predicted"]["omega_v"]["range"]) > 50
    assert "ref=speed" in capsys.readouterr().out
    assert main(["excite", *words, "bounds.omega_v=3"]) == 2
    assert "no angle" in capsys.readouterr().err
