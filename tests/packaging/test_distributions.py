"""Wheel and source distribution: what is in them, and that they work where nothing else is."""

import json
import shlex
import tarfile
import zipfile

import pytest

from tests.packaging.conftest import PROJECT, lowest, pythons, tracked

pytestmark = pytest.mark.slow

LARGEST = 3_000_000  #: bytes of the wheel

#: A first afternoon with the program.
COMMANDS = """
trms run sim.duration=4 out=newton
trms run controller=pid sim.duration=4 picture=false out=pid
trms run controller=robust_mpc_offline observer=state_dependent_ekf sim.duration=2 out=robust
trms run -m controller=pid seed=1,2 sim.duration=1 out=sweep
trms export pid/run.mcap --format parquet
trms import rig.csv
trms runs --in .
trms stability study=equilibria out=stability
trms validate real=pid/run.mcap out=validation
trms report newton --out newton.html
trms plot newton/run.mcap --format pdf --out newton.pdf
trms init my_rig
"""
#: A page of the runs, asked for as a browser does.
SERVED = """
from http.cookiejar import CookieJar
from urllib.request import HTTPCookieProcessor, build_opener
from trms_cli.library.server.application import application_of, listening_socket, running
from trms_cli.library.server.catalogue import Catalogue

with listening_socket(0) as own:
    application = application_of(Catalogue([]), own.getsockname()[1])
    with running(application, own):
        opener = build_opener(HTTPCookieProcessor(CookieJar()))
        print(opener.open(application.address).read().decode())
"""
#: What a bench writes.
RECORDING = "t[ms],u_v[%],alpha_v[deg],omega_v[rpm]\n" + "".join(
    f"{20 * k},{10 * (k % 2)},{0.1 * k},{3 * k}\n" for k in range(5)
)
#: What a user writes; a type checker has to know what comes back.
TYPED = """
from pathlib import Path
import trms_cli
from trms_cli.models.newtonian import Newtonian
from trms_cli.models.model import Model

model: Model = Newtonian()
version: str = trms_cli.__version__
wrong: int = model.axes
"""


def test_the_wheel_has_all_that_runs_and_nothing_else(distributions):
    names = zipfile.ZipFile(distributions.wheel).namelist()
    assert "trms_cli/py.typed" in names and "trms_cli/configs/run.yaml" in names
    assert any(name.endswith("licenses/LICENSE") for name in names)
    tops = {name.split("/")[0] for name in names}
    assert tops == {"trms_cli", next(top for top in tops if top.endswith(".dist-info"))}
    shipped = {name for name in names if name.startswith("trms_cli/")}
    for name in tracked():
        if name.startswith(("trms_cli/", "configs/")):
            inside = f"trms_cli/{name}" if name.startswith("configs/") else name
            assert inside in shipped, f"{name} is not in the wheel"


def test_the_wheel_is_small_and_for_every_machine(distributions):
    assert distributions.wheel.name.endswith("-py3-none-any.whl")
    assert distributions.wheel.stat().st_size < LARGEST
    with zipfile.ZipFile(distributions.wheel) as wheel:
        (about,) = (name for name in wheel.namelist() if name.endswith(".dist-info/WHEEL"))
        assert "Root-Is-Purelib: true" in wheel.read(about).decode()


def test_the_source_distribution_can_be_tested(distributions):
    with tarfile.open(distributions.sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    for needed in ("pyproject.toml", "Makefile", "requirements.lock", "README.md", "LICENSE"):
        assert needed in names
    assert "tests/packaging/test_distributions.py" in names and "docs/index.md" in names


@pytest.mark.parametrize("version", list(pythons()))
@pytest.mark.parametrize(
    "bounds",  # two at once, and what uses an environment where it is made
    [pytest.param(b, marks=pytest.mark.xdist_group(b)) for b in ("lowest", "newest")],
)
def test_it_works_outside_of_its_checkout(environment_with, bounds, version):
    if bounds == "lowest" and version != min(pythons(), key=lambda v: int(v.partition(".")[2])):
        pytest.skip("the lowest versions of dependencies are those of the lowest Python")
    environment = environment_with(pythons()[version], lowest() if bounds == "lowest" else ())
    installed = environment.run("python", "-m", "pip", "list", "--format", "json")
    versions = {package["name"]: package["version"] for package in json.loads(installed)}
    assert environment.run("trms", "--version").strip() == f"trms {versions['trms-cli']}"
    if bounds == "lowest":
        for text in lowest():
            name, _, bound = text.partition("==")
            if name in versions:  # some only for other machines
                assert versions[name].startswith(bound), f"{name} is {versions[name]}"
    assert "ready" in environment.run("trms", "doctor")
    (environment.work / "rig.csv").write_text(RECORDING, encoding="utf-8")
    for line in COMMANDS.strip().splitlines():
        environment.run(*shlex.split(line))
    score = json.loads(environment.run("trms", "score", "newton/run.mcap", "--json"))
    assert score["complete"] and score["channels"]["alpha_v"]["rmse"] < 1.0
    assert "pid" in environment.run("trms", "compare", "newton", "pid")
    assert ">newton</a>" in environment.run("python", "-c", SERVED)
    said = environment.run("trms", "run", "controller=nobody", code=2)
    assert "Traceback" not in said


@pytest.mark.xdist_group("newest")
def test_its_types_reach_a_user(environment_with, tmp_path):
    environment = environment_with(pythons()[min(pythons())], ())
    environment.run("python", "-m", "pip", "install", "--quiet", "mypy")
    script = environment.work / "mine.py"
    script.write_text(TYPED, encoding="utf-8")
    said = environment.run("python", "-m", "mypy", "--strict", "mine.py", code=1)
    assert "mine.py:9" in said and "Found 1 error" in said


def test_the_python_versions_that_are_named_begin_with_the_lowest():
    named = [c.rpartition(" ")[2] for c in PROJECT["classifiers"] if "Python :: 3." in c]
    assert PROJECT["requires-python"] == f">={named[0]}"
