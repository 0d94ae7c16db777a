"""The documentation site: it builds without a warning, and nothing in it leads nowhere.

It is built once, as `make docs` builds it, and then read as a browser reads it.
"""

import json
import re
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

import trms_cli
from trms_cli.cli import COMMANDS
from trms_cli.core.resources import config_folder

#: The build takes half a minute.
pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
#: What makes a browser fetch something by itself, by element and attribute.
_FETCHED = {("script", "src"), ("img", "src"), ("iframe", "src"), ("source", "src")}
_FETCHED |= {("video", "src"), ("audio", "src"), ("object", "data"), ("embed", "src")}
#: Links of a page's head that lead to other pages.
_NOT_FETCHED = {"index", "search", "next", "prev", "canonical"}


@dataclass
class Read(HTMLParser):
    """What a page links, what it shows, and where in it one can jump to."""

    links: list[str] = field(default_factory=list)
    fetched: list[str] = field(default_factory=list)
    anchors: set[str] = field(default_factory=set)
    scripts: str = ""
    text: str = ""

    def __post_init__(self) -> None:
        super().__init__()
        self._inside = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.anchors |= {given[name] for name in ("id", "name") if given.get(name)}
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
        if tag == "link" and given.get("rel") not in _NOT_FETCHED:
            self.fetched.append(given.get("href", ""))
        self.fetched += [given[name] for name in given if (tag, name) in _FETCHED]
        self._inside = tag

    def handle_data(self, data: str) -> None:
        if self._inside in ("script", "style"):
            self.scripts += data
        else:
            self.text += data


@pytest.fixture(scope="session")
def pages(site: Path) -> dict[Path, Read]:
    """Every page of the site, read."""
    found = {}
    for file in sorted(site.rglob("*.html")):
        found[file] = Read()
        found[file].feed(file.read_text(encoding="utf-8"))
    assert len(found) > 80
    return found


def test_every_link_and_anchor_leads_somewhere_and_never_to_the_disk_of_who_built_it(
    site: Path, pages: dict[Path, Read]
) -> None:
    lost = set()
    for file, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            what = f"{file.relative_to(site)}: {link}"
            assert parts.scheme in ("", "https", "mailto"), what
            # what has no address is told from the page
            assert parts.netloc or not parts.path.startswith("/"), what
            assert str(ROOT) not in unquote(link), what
            if parts.scheme or parts.netloc:
                continue
            target = (file.parent / unquote(parts.path)).resolve() if parts.path else file
            anchor = unquote(parts.fragment) if target.suffix == ".html" else ""
            if not target.is_file() or (anchor and anchor not in pages[target].anchors):
                lost.add(what)
    assert not lost, "\n".join(sorted(lost)[:40])


def test_all_that_is_fetched_is_there_and_nothing_is_from_elsewhere(
    site: Path, pages: dict[Path, Read]
) -> None:
    for file, page in pages.items():
        for link in page.fetched:
            if link.startswith("data:"):
                continue
            assert not re.match(r"(https?:)?//", link), f"{file.name} fetches {link}"
            target = file.parent / unquote(urlsplit(link).path)
            assert target.is_file(), f"{file.relative_to(site)}: {link}"
        assert not re.search(r"(https?:)?//[\w.-]*(cdn|googleapis|unpkg)", page.scripts), file.name
    for file in site.rglob("*.css"):
        text = file.read_text(encoding="utf-8")
        assert not re.search(r"(@import|url\()\s*['\"]?(https?:)?//", text), file.name


def test_formulas_of_the_lessons_are_set_and_not_shown_as_they_are_typed(site: Path) -> None:
    for lesson in (ROOT / "docs" / "course").glob("*.ipynb"):
        cells = json.loads(lesson.read_text(encoding="utf-8"))["cells"]
        prose = "\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "markdown")
        typed = re.findall(r"(\$\$?)[^$]+\1", prose)
        page = (site / "course" / f"{lesson.stem}.html").read_text(encoding="utf-8")
        assert page.count("<math") == len(typed) > 0, lesson.name


def test_every_page_is_reached_from_the_front_page(site: Path, pages: dict[Path, Read]) -> None:
    seen, waiting = set(), [site / "index.html"]
    while waiting:
        file = waiting.pop()
        if file in seen or file not in pages:
            continue
        seen.add(file)
        links = (urlsplit(link) for link in pages[file].links)
        waiting += [
            (file.parent / unquote(p.path)).resolve() for p in links if p.path and not p.netloc
        ]
    apart = {"search.html", "genindex.html", "py-modindex.html"}
    lost = {str(file.relative_to(site)) for file in set(pages) - seen}
    assert lost <= apart, f"pages that nothing leads to: {sorted(lost - apart)}"


def test_every_command_and_schema_is_in_the_reference(pages: dict[Path, Read], site: Path) -> None:
    for name in COMMANDS:
        page = pages[site / "reference" / "commands" / f"{name}.html"]
        assert f"trms {name}" in page.text
    run = pages[site / "reference" / "commands" / "run.html"].text
    assert "sim.sample_time" in run and "s, period" not in run and "period of the log" in run
    formats = pages[site / "reference" / "formats.html"].text
    for schema in ("trms.score/1", "trms.run/1", "trms.diagnosis/1", "trms.validation/1"):
        assert schema in formats


def test_every_group_and_option_is_in_the_reference(pages: dict[Path, Read], site: Path) -> None:
    reference = site / "reference" / "configuration"
    for file in config_folder().glob("*/*.yaml"):
        option = file.stem.lower()
        anchors = pages[reference / f"{file.parent.name}.html"].anchors
        assert {option, option.replace("_", "-")} & anchors, option
    # a key has its default, unit and meaning
    text = " ".join(pages[reference / "controller.html"].text.split())
    assert "controller.sample_time 0.1 s control period; a whole multiple" in text
    sets = " ".join(pages[reference / "parameters.html"].text.split())
    assert "k_g 0.0123 m*s 30 %" in sets


def test_protocols_of_plugins_and_what_the_library_exports_are_in_the_reference(
    pages: dict[Path, Read], site: Path
) -> None:
    python = {file: p.anchors for file, p in pages.items() if "reference/python" in file.as_posix()}
    every = {anchor.rpartition(".")[2] for anchors in python.values() for anchor in anchors}
    assert {"Model", "Effect", "Controller", "Observer", "Signal", "Plant"} <= every
    library = python[site / "reference" / "python" / "library.html"]
    told = {anchor.rpartition(".")[2] for anchor in library}
    assert {name for name in trms_cli.__all__ if name[0] != "_"} <= told


def test_the_search_finds_pages_that_exist(site: Path) -> None:
    index = (site / "searchindex.js").read_text(encoding="utf-8")
    found = json.loads(index[index.index("(") + 1 : index.rindex(")")])
    for name in found["docnames"]:
        assert (site / f"{name}.html").is_file(), name
    assert "tutorial" in found["docnames"] and "coulomb" in found["terms"]
