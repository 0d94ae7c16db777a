"""``trms export-controller`` as a person meets it: its folder, its figures, its refusals."""

import json
import shutil
import subprocess

import pytest

from trms_cli.cli import main
from trms_cli.core.compilation import compiler

needs_compiler = pytest.mark.skipif(compiler() is None, reason="needs a C compiler")
SMALL = (
    "controller.prediction_horizon=8",
    "sim.duration=10",
    "model=newtonian_vertical",
    "model@plant.model=newtonian_vertical",
)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("export") / "rig"
    command = ["export-controller", "newton_mpc", *SMALL, "name=rig", f"out={folder}"]
    assert main(command) == 0
    return folder


@needs_compiler
def test_it_leaves_source_example_and_figures(exported):
    files = {path.name for path in exported.iterdir()}
    assert files == {
        *("rig.c", "rig.h", "rig_example.c", "Makefile"),
        *("example.csv", "README.md", "controller.json"),
    }
    document = json.loads((exported / "controller.json").read_text())
    assert document["schema"] == "trms.export-controller/1"
    assert document["observer"]["channels"] == ["alpha_v", "omega_v"]
    measured = document["measured"]
    assert measured["samples"] == 5 * 100 and measured["failed"] == 0
    assert measured["largest_difference"] <= 1e-9
    assert 0 < measured["median"] <= measured["p99"] <= measured["longest"]
    assert measured["context_bytes"] > 1000 and measured["observer_bytes"] > 1000
    assert measured["observer_median"] > 0
    readme = (exported / "README.md").read_text()
    for word in ("| `x_hat` | 2 | alpha_v", "| `y` | 0 | alpha_v", "torque on pitch", "N*m"):
        assert word in readme
    assert f"{measured['median']:.1f} µs" in readme and "trms export-controller" in readme


@needs_compiler
def test_a_linear_mpc_is_exported_too(tmp_path, capsys):
    folder = tmp_path / "linear"
    words = ("observer=full_state", "controller.move_blocks=[1, 1, 2, 4]", f"out={folder}")
    assert main(["export-controller", "linear_mpc", *SMALL, *words]) == 0
    assert "linear_mpc: linear_mpc of model newtonian, 8 periods" in capsys.readouterr().out
    measured = json.loads((folder / "controller.json").read_text())["measured"]
    assert measured["failed"] == 0 and measured["largest_difference"] <= 1e-9
    assert (folder / "README.md").read_text().startswith("# linear_mpc: Linear MPC in C\n")


@needs_compiler
@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_its_makefile_builds_and_checks(exported, tmp_path):
    folder = shutil.copytree(exported, tmp_path / "copy")
    command = ["make", "-C", str(folder), "check", f"CC={compiler()}", "CFLAGS=-std=c99 -O1"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "largest_difference_V" in done.stdout


#: All that a structure may have, followed where bounds, rates and limits act.
EVERYTHING = (
    *("controller.terminal=quasi_infinite", "controller.prediction_horizon=20"),
    "controller.input_rate_limits={u_v: 6.0, u_h: 8.0}",
    "controller.soft_limits={alpha_v: [-0.7, 0.25], alpha_h: [-0.4, 0.4]}",
    *("controller.preview_horizon=4", "controller.input_weights={u_v: 0.05}", "sim.duration=45"),
)


@needs_compiler
@pytest.mark.slow
def test_nothing_is_undefined_or_out_of_bounds_with_everything(tmp_path):
    folder = tmp_path / "rig"
    command = ["export-controller", "newton_mpc", *EVERYTHING, "name=rig", f"out={folder}"]
    assert main([*command, "measure=false"]) == 0
    test_nothing_is_undefined_or_out_of_bounds(folder, tmp_path)


@needs_compiler
@pytest.mark.slow
def test_nothing_is_undefined_or_out_of_bounds(exported, tmp_path):
    flags = ["-std=c99", "-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    sources = [str(exported / "rig.c"), str(exported / "rig_example.c")]
    program = str(tmp_path / "checked")
    command = [str(compiler()), *flags, f"-I{exported}", *sources, "-o", program, "-lm"]
    built = subprocess.run(command, capture_output=True, text=True)
    if built.returncode and "sanitize" in built.stderr:
        pytest.skip("the compiler has no sanitizers")
    assert built.returncode == 0, built.stderr
    done = subprocess.run([program, str(exported / "example.csv")], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""


@needs_compiler
def test_the_example_follows_the_table_it_is_given(exported, tmp_path):
    flags = ["-std=c99", "-O1", "-Wall", "-Wextra", "-Werror", "-pedantic", f"-I{exported}"]
    program = str(tmp_path / "example")
    sources = [str(exported / "rig.c"), str(exported / "rig_example.c")]
    subprocess.run([str(compiler()), *flags, *sources, "-o", program, "-lm"], check=True)
    table = exported / "example.csv"
    printed = subprocess.check_output([program, "--print", str(table)], text=True).splitlines()
    rows = [line for line in table.read_text().splitlines() if not line.startswith("#")]
    for said, row in zip(printed, rows, strict=True):
        assert float(said) == pytest.approx(float(row.split(",")[-1]), abs=1e-9)
    wrong = tmp_path / "wrong.csv"
    wrong.write_text("1,2,3\n")
    assert subprocess.run([program, str(wrong)], capture_output=True).returncode == 2


def test_without_a_compiler_it_writes_and_says_so(tmp_path, capsys, monkeypatch):
    compiler.cache_clear()
    monkeypatch.setenv("TRMS_COMPILE", "0")
    out = tmp_path / "x"
    words = ("observer=full_state", f"out={out}")
    try:
        assert main(["export-controller", "newton_mpc", *SMALL, *words]) == 0
    finally:
        compiler.cache_clear()
    assert "not measured: no C compiler found" in capsys.readouterr().out
    assert "Not measured here" in (out / "README.md").read_text()
    assert json.loads((out / "controller.json").read_text())["measured"] is None
    assert (out / "newton_mpc.c").is_file()
    assert "observe(" not in (out / "newton_mpc.h").read_text()  # full_state needs none


@pytest.mark.parametrize(
    ("override", "where", "words"),
    [
        ("controller=pid", "controller", "controller=pid has no C source"),
        (
            "qp_solver@controller.qp=osqp",
            "controller.qp",
            "only the engine's own QP solver has C source",
        ),
        ("plant=replay plant.file=x.csv", "plant", "recording"),
        ("name=Rig", "name", "'Rig' given"),
        ("name=mpc", "name", "'mpc' given"),
        ("measure=perhaps", "measure", "'perhaps' given"),
        ("sim.duration=1e6", "sim.duration", "control periods"),
    ],
)
def test_what_cannot_be_is_refused_in_words(override, where, words, refused):
    refused("export-controller", *override.split(), "out=x", words=[words, f"in {where}"])


@pytest.mark.parametrize(
    ("words", "told"),
    [(["newtonn_mpc"], "newton_mpc"), (["newton_mpc", "out=."], "nothing is written over")],
)
def test_another_controller_and_a_full_folder_are_refused(refused, tmp_path, words, told):
    (tmp_path / "mine.txt").write_text("keep")
    refused("export-controller", *words, words=told)
