"""What a release tells in several files is the same in all of them."""

import re
import tomllib
from pathlib import Path

import yaml

import trms_cli

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def newest_release() -> tuple[str, str]:
    """Version and date of the newest section of the changelog that is a release."""
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    found = re.search(r"^## (\d+\.\d+\.\d+) \((\d{4}-\d\d-\d\d)\)$", text, re.M)
    assert found is not None
    return found[1], found[2]


def test_the_version_and_its_date_are_the_same_everywhere():
    version, date = newest_release()
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert version == trms_cli.__version__ == citation["version"]
    assert date == str(citation["date-released"])


def test_the_citation_names_what_the_project_is():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["license"] == PROJECT["license"]
    assert citation["type"] == "software" and citation["authors"] and citation["message"]
    assert citation["cff-version"] == "1.2.0"


def test_a_first_version_is_told_to_be_stable():
    (status,) = (c for c in PROJECT["classifiers"] if c.startswith("Development Status"))
    assert ("Production/Stable" in status) == (int(trms_cli.__version__.split(".")[0]) >= 1)
