"""The documentation site: it builds without a warning, and nothing in it leads nowhere.

It is built once, as `make docs` builds it, and then read as a browser reads it.
"""

from __future__ import annotations

import fcntl
import json
import re
import subprocess
import sys
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

from trms_cli.cli import COMMANDS
from trms_cli.core.resources import config_folder

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
def site(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Path:
    """The site, built once for all workers of a test run."""
    base = tmp_path_factory.getbasetemp()
    shared = base if worker_id == "master" else base.parent
    out, said = shared / "site", shared / "site.log"
    with (shared / "site.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not said.exists():
            command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html"]
            command += ["-d", str(shared / "doctrees"), str(ROOT / "docs"), str(out)]
            done = subprocess.run(command, capture_output=True, text=True, timeout=900)
            said.write_text(f"{done.returncode}\n{done.stdout}{done.stderr}", encoding="utf-8")
    code, _, words = said.read_text(encoding="utf-8").partition("\n")
    assert code == "0", f"the site does not build without a warning:\n{words[-6000:]}"
    return out


@pytest.fixture(scope="session")
def worker_id(request: pytest.FixtureRequest) -> str:
    """Name of the process that runs these tests, also where tests run in one."""
    return str(getattr(request.config, "workerinput", {}).get("workerid", "master"))


@pytest.fixture(scope="session")
def pages(site: Path) -> dict[Path, Read]:
    """Every page of the site, read."""
    found = {}
    for file in sorted(site.rglob("*.html")):
        found[file] = Read()
        found[file].feed(file.read_text(encoding="utf-8"))
    assert len(found) > 80
    return found


def test_every_link_and_anchor_leads_somewhere(site: Path, pages: dict[Path, Read]) -> None:
    lost = []
    for file, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (file.parent / unquote(parts.path)).resolve() if parts.path else file
            if not target.is_file() or (
                parts.fragment
                and target.suffix == ".html"
                and unquote(parts.fragment) not in pages[target].anchors
            ):
                lost.append(f"{file.relative_to(site)}: {link}")
    assert not lost, "\n".join(sorted(set(lost))[:40])


def test_pictures_styles_and_scripts_are_there(site: Path, pages: dict[Path, Read]) -> None:
    for file, page in pages.items():
        for link in page.fetched:
            if link.startswith("data:"):
                continue
            assert not re.match(r"(https?:)?//", link), f"{file.name} fetches {link}"
            target = file.parent / unquote(urlsplit(link).path)
            assert target.is_file(), f"{file.relative_to(site)}: {link}"


def test_nothing_is_fetched_from_elsewhere(site: Path, pages: dict[Path, Read]) -> None:
    for file, page in pages.items():
        assert not re.search(r"(https?:)?//[\w.-]*(cdn|googleapis|unpkg)", page.scripts), file.name
    for file in site.rglob("*.css"):
        text = file.read_text(encoding="utf-8")
        assert not re.search(r"(@import|url\()\s*['\"]?(https?:)?//", text), file.name


def test_only_web_pages_that_a_page_names_are_linked(site: Path, pages: dict[Path, Read]) -> None:
    for file, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            assert parts.scheme in ("", "https", "mailto"), f"{file.name}: {link}"
            # nothing on the disk of who built it: what has no address is told from the page
            assert parts.netloc or not parts.path.startswith("/"), f"{file.name}: {link}"
            assert str(ROOT) not in unquote(link), f"{file.name}: {link}"


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


def test_every_command_is_in_the_reference(pages: dict[Path, Read], site: Path) -> None:
    for name in COMMANDS:
        page = pages[site / "reference" / "commands" / f"{name}.html"]
        assert f"trms {name}" in page.text
    run = pages[site / "reference" / "commands" / "run.html"].text
    assert "sim.sample_time" in run and "s, period" not in run and "period of the log" in run


def test_every_group_and_option_is_in_the_reference(pages: dict[Path, Read], site: Path) -> None:
    for folder in config_folder().iterdir():
        options = [file.stem for file in folder.glob("*.yaml")] if folder.is_dir() else []
        if not options:
            continue
        page = pages[site / "reference" / "configuration" / f"{folder.name}.html"]
        headings = page.anchors
        for option in options:
            named = {option.lower(), option.replace("_", "-").lower()}
            assert named & headings, option


def test_a_key_has_its_default_unit_and_meaning(pages: dict[Path, Read], site: Path) -> None:
    text = " ".join(pages[site / "reference" / "configuration" / "controller.html"].text.split())
    assert "controller.sample_time 0.1 s control period; a whole multiple" in text
    sets = " ".join(pages[site / "reference" / "configuration" / "parameters.html"].text.split())
    assert "k_g 0.0123 m*s 30 %" in sets


@pytest.mark.parametrize("name", ["Model", "Effect", "Controller", "Observer", "Signal", "Plant"])
def test_protocols_of_plugins_are_in_the_reference(
    pages: dict[Path, Read], site: Path, name: str
) -> None:
    found = [page for file, page in pages.items() if "reference/python" in file.as_posix()]
    assert any(anchor.endswith(f".{name}") for page in found for anchor in page.anchors)


def test_what_the_library_exports_is_in_the_reference(pages: dict[Path, Read], site: Path) -> None:
    import trms_cli

    anchors = pages[site / "reference" / "python" / "library.html"].anchors
    for name in trms_cli.__all__:
        if name[0] != "_":
            assert any(anchor.endswith(f".{name}") for anchor in anchors), name


def test_schemas_are_listed(pages: dict[Path, Read], site: Path) -> None:
    text = pages[site / "reference" / "formats.html"].text
    for schema in ("trms.score/1", "trms.run/1", "trms.diagnosis/1", "trms.validation/1"):
        assert schema in text


def test_the_search_finds_pages_that_exist(site: Path) -> None:
    index = (site / "searchindex.js").read_text(encoding="utf-8")
    found = json.loads(index[index.index("(") + 1 : index.rindex(")")])
    for name in found["docnames"]:
        assert (site / f"{name}.html").is_file(), name
    assert "tutorial" in found["docnames"] and "coulomb" in found["terms"]
