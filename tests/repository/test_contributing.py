"""The guide leads through the program as it is."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
GUIDE = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")


def test_every_room_of_the_program_has_its_line_and_no_other():
    rows = GUIDE.partition("look in `trms_cli/`")[2].partition("\n\n")[0]
    named = set(re.findall(r"`(\w+)/", rows))
    rooms = {
        path.name
        for path in (ROOT / "trms_cli").iterdir()
        if path.is_dir() and path.name[0] != "_" and any(path.glob("*.py"))
    }
    assert named == rooms
    for name in re.findall(r"`((?:\w+/)+[a-z_]+\.py)`", rows):
        assert (ROOT / "trms_cli" / name).is_file(), name


def test_the_targets_and_files_that_it_names_exist():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^([a-z0-9-]+):", makefile, re.MULTILINE))
    assert set(re.findall(r"`make ([a-z0-9-]+)", GUIDE)) <= targets
    files = re.findall(r"`((?:trms_cli|tests|experiments|docs|\.ci)/[\w./-]+)`", GUIDE)
    assert files and all((ROOT / name).exists() for name in files)
