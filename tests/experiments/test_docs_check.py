"""What made the tables and pictures of the pages is known, and what moved is told."""

import importlib.util
import re
import shlex
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from experiments.docs_check.__main__ import main
from experiments.docs_check.anew import argv_of, make_anew
from experiments.docs_check.comparison import compare_blocks, picture_difference
from experiments.docs_check.sources import Source, made_by, read_sources, source_of
from experiments.page_blocks import blocks_of, pictures_of
from experiments.provenance import (
    ROOT,
    complete,
    contents_of_all,
    read_ledger,
    record_publication,
    write_ledger,
)
from trms_cli.cli import COMMANDS
from trms_cli.core.errors import ConfigurationError
from trms_cli.library.tasks.git_revision import known_revision

SOURCES = read_sources()

PAGE = """# A page

<!-- a b: begin -->
| x | [s] |
|---|---|
| 1.0 | 2 |
<!-- a b: end -->

<!-- made: about begin -->
3 runs
<!-- made: about end -->

<!-- table c -->
four
<!-- end -->

<!-- derived: d -->
```text
x = 1
```

![shown](figures/p.png) and [linked](figures/q.svg), [other](page.md)
"""


@pytest.fixture(scope="module")
def keys():
    return list(contents_of_all())


def test_every_table_and_picture_of_the_pages_knows_its_command(keys):
    assert len(keys) > 200
    assert [key for key in keys if source_of(key, SOURCES) is None] == []


@pytest.mark.parametrize("name", SOURCES)
def test_the_command_of_a_source_is_there_and_so_is_what_it_makes(name, keys):
    source = SOURCES[name]
    assert bool(source.command) != bool(source.by_hand)
    if source.target:
        targets = re.findall(r"^([a-z0-9-]+):.*## ", (ROOT / "Makefile").read_text(), re.MULTILINE)
        if source.target not in targets:
            assert not made_by(name, SOURCES, keys), source.target
            return
    words = shlex.split(source.command)
    if words[:2] == ["python", "-m"]:
        assert importlib.util.find_spec(words[2]) is not None
    elif words:
        assert words[0] == "trms"
    pages = [page for page in source.tables if (ROOT / page).exists()]
    if not pages and not source.pictures:
        return
    if pages or not source.tables:
        for page in pages:
            for pattern in source.tables[page]:
                one = Source("", {page: [pattern]}, [])
                assert made_by("one", {"one": one}, keys), f"{name}: no table {page} {pattern}"
        for pattern in source.pictures:
            one = Source("", {}, [pattern])
            assert made_by("one", {"one": one}, keys), f"{name}: no picture {pattern}"
    for pattern in source.timed:
        assert made_by("one", {"one": Source("", {}, [pattern])}, made_by(name, SOURCES, keys))


def test_every_command_of_the_thesis_page_is_there():
    """Its links are followed with those of all pages; a row is whole, or says what is missing."""
    text = (ROOT / "docs" / "thesis.md").read_text(encoding="utf-8")
    assert [f"Chapter {i}" in text for i in range(1, 10)] == [True] * 9
    rows = [line.split(" | ") for line in text.splitlines() if line.startswith("| ")]
    rows = [row for row in rows if row[0] != "| row"]
    assert len(rows) > 50
    for _, typed, _, status in rows:
        assert status.startswith(("whole", "partly: ")), status
        for command in re.findall(r"`([^`]+)`", typed):
            words = shlex.split(command)
            if words[0] == "make":
                assert re.search(rf"^{words[1]}:", (ROOT / "Makefile").read_text(), re.MULTILINE)
            elif words[0] == "python":
                assert importlib.util.find_spec(words[2]) is not None
            else:
                assert words[:1] == ["trms"] and words[1] in COMMANDS
                groups = [word.split("=") for word in words[2:] if "." not in word.split("=")[0]]
                assert all((ROOT / "configs" / g / f"{o}.yaml").is_file() for g, o in groups)


def test_what_ci_makes_anew_takes_less_than_a_minute():
    cheap = [source for source in SOURCES.values() if source.cheap]
    assert len(cheap) >= 2 and sum(source.seconds for source in cheap) < 45


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="no history")
def test_every_committed_table_and_picture_knows_its_revision(keys):
    changed = subprocess.run(
        ["git", "-C", str(ROOT), "status", "--porcelain", "--no-renames"],
        capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    files = {line[3:].strip('"') for line in changed.splitlines()}
    origins = complete(read_ledger())
    unknown = {key for key in keys if key not in origins and key.partition("#")[0] not in files}
    assert {key for key in unknown if not any(key.startswith(file) for file in files)} == set()


def test_blocks_of_all_studies_and_pictures_are_seen():
    blocks = blocks_of(PAGE)
    assert [block.name for block in blocks] == ["a b", "about", "c", "d"]
    assert blocks[0].text.endswith("| 1.0 | 2 |") and blocks[3].text.startswith("```text")
    lines = PAGE.splitlines()
    for block in blocks:
        assert "\n".join(lines[i - 1] for i in block.lines) == block.text
    assert pictures_of(PAGE) == ["figures/p.png", "figures/q.svg"]
    with pytest.raises(ValueError, match="no end"):
        blocks_of("<!-- a: begin -->\nx\n<!-- b: end -->\n")


TABLE = """| case | RMSE [rad] | time [s] |
|---|---|---|
| one | 0.123 (−1.5e−03) | 5.2 |
| two | 163, 12 | 600 |
12 runs in all"""


@pytest.mark.parametrize(
    ("before", "after", "moved"),
    [
        ("0.123", "0.124", None),  # rounding
        ("0.123", "0.1240", None),
        ("0.123", "0.126", ("one, RMSE [rad]", "0.126")),
        ("−1.5e−03", "1.5e−03", ("one", "(1.5e−03)")),
        ("−1.5e−03", "−1.6e−03", None),
        ("163", "164", None),  # three digits: rounded
        ("163, 12", "163, 13", ("two", "163, 13")),  # a count
        ("5.2", "9.9 s", None),  # a time
        ("600", "225 (186–600)", None),
        ("0.123 (", "– (", ("one", "– (")),
        ("12 runs", "13 runs", ("", "13 runs in all")),
        ("12 runs", "12 failures", ("", "12 failures in all")),
        ("| two | 163, 12 | 600 |\n", "", ("two", "")),
        ("12 runs", "a line\n12 runs", ("", "a line")),
    ],
)
def test_what_moved_is_named_with_its_row_old_and_new(before, after, moved):
    changes = compare_blocks(TABLE, TABLE.replace(before, after, 1), "docs/p.md#t", 0.0, ["time"])
    if moved is None:
        assert changes == []
        return
    (change,) = changes
    row, new = moved
    assert change.where == "docs/p.md#t" and row in change.row and new in change.new
    assert "→" in str(change) and "docs/p.md#t" in str(change)


def test_a_share_of_a_number_may_be_allowed():
    new = TABLE.replace("0.123", "0.126")
    assert compare_blocks(TABLE, new, "", 0.02, []) == []
    assert len(compare_blocks(TABLE, new, "", 0.01, [])) == 1
    assert compare_blocks(TABLE, new, "", 0.0, [], digits=3.0) == []
    assert len(compare_blocks(TABLE, new, "", 0.0, [], digits=2.0)) == 1


def test_pictures_differ_by_the_share_of_their_area(tmp_path):
    image = np.full((80, 80, 3), 255, dtype=np.uint8)
    old, same, other, larger = (tmp_path / f"{i}.png" for i in range(4))
    Image.fromarray(image).save(old)
    image[0, 0] = 250  # nobody sees it
    Image.fromarray(image).save(same)
    image[:8, :40] = 0  # five of a hundred tiles
    Image.fromarray(image).save(other)
    Image.fromarray(np.full((88, 80, 3), 255, dtype=np.uint8)).save(larger)
    assert picture_difference(old, same) == 0.0
    assert picture_difference(old, other) == pytest.approx(0.05)
    assert picture_difference(old, larger) == 1.0
    for name, x in (("a.svg", 1.0), ("b.svg", 1.001), ("c.svg", 2.0)):
        (tmp_path / name).write_text(f'<svg><path d="M {x} 0"/></svg>')
    assert picture_difference(tmp_path / "a.svg", tmp_path / "b.svg") == 0.0
    assert picture_difference(tmp_path / "a.svg", tmp_path / "c.svg") == 1.0


@pytest.fixture
def checkout(tmp_path):
    """A small checkout with a page, its picture and the script that makes both."""
    root = tmp_path / "checkout"
    (root / "docs" / "figures").mkdir(parents=True)
    (root / "docs" / "page.md").write_text(PAGE)
    Image.new("RGB", (16, 16), "white").save(root / "docs" / "figures" / "p.png")
    (root / "docs" / "figures" / "q.svg").write_text("<svg/>")
    return root


def test_a_publication_puts_down_its_revision_and_history_fills_the_rest(checkout):
    def git(*words):
        subprocess.run(["git", "-C", checkout, *words], check=True, capture_output=True)

    git("init", "-q")
    git("add", ".")
    git("-c", "user.name=a", "-c", "user.email=a@b", "commit", "-q", "-m", "first")
    page, ledger = checkout / "docs" / "page.md", checkout / "docs" / "provenance.json"
    origins = complete({}, checkout)
    assert origins.keys() == contents_of_all(checkout).keys() and len(origins) == 6
    assert {origin.evidence for origin in origins.values()} == {"history"}
    write_ledger(origins, ledger)
    assert read_ledger(ledger) == origins

    # the one table that is written again is of this revision, and so is the picture that changed
    page.write_text(PAGE.replace("3 runs", "4 runs"))
    Image.new("RGB", (16, 16), "black").save(checkout / "docs" / "figures" / "p.png")
    with known_revision("abc-dirty"):
        record_publication(page, ["about"], checkout)
    origins = read_ledger(ledger)
    new = {key for key, origin in origins.items() if origin.revision == "abc-dirty"}
    assert new == {"docs/page.md#about", "docs/figures/p.png"}
    assert complete(origins, checkout) == origins

    # what is written by hand over it is of nobody's, until it is committed
    page.write_text(PAGE.replace("3 runs", "5 runs"))
    assert "docs/page.md#about" not in complete(origins, checkout)
    git("-c", "user.name=a", "-c", "user.email=a@b", "commit", "-q", "-a", "-m", "second")
    assert complete(origins, checkout)["docs/page.md#about"].evidence == "history"


def test_pages_elsewhere_and_checkouts_without_git_have_no_revision(checkout, tmp_path):
    (tmp_path / "page.md").write_text(PAGE)
    with known_revision("abc"):
        record_publication(tmp_path / "page.md", ["about"], checkout)
    with known_revision(""):
        record_publication(checkout / "docs" / "page.md", ["about"], checkout)
    assert not (checkout / "docs" / "provenance.json").exists()
    damaged = tmp_path / "provenance.json"
    damaged.write_text("[]")
    with pytest.raises(ConfigurationError, match="no record"):
        read_ledger(damaged)


SCRIPT = """
import sys
from pathlib import Path
from PIL import Image
page = Path("docs/page.md")
page.write_text(page.read_text().replace("| 1.0 | 2 |", "| NEW | 9 |"))
Image.new("RGB", (16, 16), "COLOUR").save("docs/figures/p.png")
sys.exit(CODE)
"""


@pytest.mark.parametrize(
    ("new", "colour", "code", "moved"),
    [
        ("1.0", "white", 0, []),
        ("1.4", "white", 0, ["docs/page.md#a b"]),
        ("1.4", "black", 0, ["docs/page.md#a b", "docs/figures/p.png"]),
        ("1.0", "white", 3, None),
    ],
)
def test_made_anew_in_a_copy_it_is_compared_and_the_page_stays(
    checkout, tmp_path, new, colour, code, moved
):
    script = SCRIPT.replace("NEW", new).replace("COLOUR", colour).replace("CODE", str(code))
    (checkout / "study.py").write_text(script)
    source = Source("python study.py", {"docs/page.md": ["*"]}, ["docs/figures/p.png"], times=["s"])
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    keys = ["docs/page.md#a b", "docs/page.md#about", "docs/figures/p.png"]
    outcome = make_anew("study", source, keys, scratch, root=checkout)
    if moved is None:
        assert "exit code 3" in outcome.problem
    else:
        assert not outcome.problem and outcome.compared == 3
        assert [change.where for change in outcome.changes] == moved
    assert (checkout / "docs" / "page.md").read_text() == PAGE
    assert [path.name for path in scratch.iterdir()] == ["study.log"]


def test_a_source_that_wants_recordings_says_so(tmp_path):
    source = Source("trms run plant.file={records}/tras/a.csv", {}, [])
    with pytest.raises(ConfigurationError, match="recordings"):
        argv_of(source, None)
    words = argv_of(source, tmp_path)
    assert words[:3] == [sys.executable, "-m", "trms_cli"] and str(tmp_path) in words[-1]
    assert "recordings" in make_anew("a", source, [], tmp_path).problem


def test_the_list_names_command_revision_and_age(capsys):
    assert main(["--list", "--only", "chapter2"]) == 0
    words = capsys.readouterr().out
    assert "chapter2: python -m experiments.chapter2" in words
    assert re.search(r"docs/chapter2.md#bench tests +\S+ .*\d{4}-\d\d-\d\d, \d+ d", words)
    assert "docs/figures/chapter2/rotors.png" in words and "chapter5" not in words
    for wrong in (["--only", "chapter22"], ["--source", "chapter22"]):
        assert main(wrong) == 2
        assert "chapter2" in capsys.readouterr().err


@pytest.mark.slow
def test_what_takes_seconds_comes_out_again(capsys):
    code = main(["--cheap"])
    assert code == 0, capsys.readouterr().out[-4000:]
