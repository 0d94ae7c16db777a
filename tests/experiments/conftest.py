"""The studies lie beside the package and are not installed: make them importable."""

import importlib
import json
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = str(Path(__file__).parents[2])
if ROOT not in sys.path:
    sys.path.append(ROOT)

#: The studies are in the checkout only.
collect_ignore_glob = [] if find_spec("experiments") else ["*"]


def chapter(request: pytest.FixtureRequest, module: str):
    """A module of the chapter that a file of tests is of."""
    name = request.module.__name__.rpartition("test_")[2]
    return importlib.import_module(f"experiments.{name}.{module}")


@pytest.fixture(scope="module")
def study(request):
    """The study of a chapter."""
    return chapter(request, "study").read_study()


@pytest.fixture(scope="module")
def expected(request):
    """The figures that a chapter's page shows."""
    return json.loads(chapter(request, "__main__").EXPECTED.read_text(encoding="utf-8"))
