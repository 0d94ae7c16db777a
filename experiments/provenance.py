"""At which revision each table and picture of the pages was made: ``docs/provenance.json``.

A study that writes its tables into a page has the revision put down (`record_publication`). What
was put into a page in another way has the commit that brought it as it is, which
``python -m experiments.docs_check --record`` asks of git once.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import msgspec

from experiments.page_blocks import blocks_of, pictures_of
from trms_cli.core.errors import ConfigurationError
from trms_cli.library.tasks.git_revision import GitRevision

ROOT = Path(__file__).resolve().parents[1]
LEDGER = ROOT / "docs" / "provenance.json"
SCHEMA = "trms.provenance/1"
#: What a picture ends with.
PICTURES = (".png", ".svg", ".gif")


class Origin(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where a table or a picture, as it is now, comes from."""

    sha256: str  #: Of its text or its bytes, the first 16 digits
    revision: str  #: That it was made at, or, by its history, of the commit that brought it
    date: str  #: Of that, ISO
    evidence: Literal["publication", "history"]


#: By page and block, ``docs/chapter5.md#modes``, or by picture, ``docs/figures/run.png``.
Ledger = dict[str, Origin]


class _File(msgspec.Struct, forbid_unknown_fields=True):
    schema: str
    origins: Ledger


def digest(content: str | bytes) -> str:
    """What tells whether a table or a picture is still the one that was put down."""
    data = content.encode() if isinstance(content, str) else content
    return hashlib.sha256(data).hexdigest()[:16]


def contents(page: Path, root: Path = ROOT) -> dict[str, str]:
    """The digest of every block of a page and of every picture that it shows or links."""
    text = page.read_text(encoding="utf-8")
    name = page.relative_to(root).as_posix()
    digests = {f"{name}#{block.name}": digest(block.text) for block in blocks_of(text)}
    for link in pictures_of(text):
        picture = (page.parent / link).resolve()
        if picture.is_relative_to(root) and picture.is_file():
            digests[picture.relative_to(root).as_posix()] = digest(picture.read_bytes())
    return digests


def contents_of_all(root: Path = ROOT) -> dict[str, str]:
    """The same of all pages and of all pictures, shown or not."""
    digests = {key: value for page in pages_of(root) for key, value in contents(page, root).items()}
    return digests | {key: digest((root / key).read_bytes()) for key in pictures_in(root)}


def pages_of(root: Path = ROOT) -> list[Path]:
    """The pages: README, docs/ without what the site generates, and the studies' own."""
    patterns = ("README.md", "docs/*.md", "docs/how-to/*.md", "experiments/*/README.md")
    return sorted(page for pattern in patterns for page in root.glob(pattern))


def pictures_in(root: Path = ROOT) -> list[str]:
    """Every picture of docs/ and of the studies' own pages."""
    folders = (root / "docs" / "figures", root / "experiments")
    files = (file for folder in folders for file in folder.rglob("*") if file.suffix in PICTURES)
    return sorted(file.relative_to(root).as_posix() for file in files)


def read_ledger(file: Path = LEDGER) -> Ledger:
    """What is put down; nothing where there is no file.

    Raises ConfigurationError if it is damaged.
    """
    if not file.is_file():
        return {}
    try:
        return msgspec.json.decode(file.read_bytes(), type=_File).origins
    except msgspec.MsgspecError as error:
        raise ConfigurationError(
            f"this is no record of what made the pages: {error}",
            where=str(file),
            remedy=f"take the committed one: git checkout -- {file.name}",
        ) from error


def write_ledger(ledger: Mapping[str, Origin], file: Path = LEDGER) -> None:
    """An entry a line, so that studies published side by side are merged by git."""
    lines = [
        f"{json.dumps(key)}: {msgspec.json.encode(origin).decode()}"
        for key, origin in sorted(ledger.items())
    ]
    words = ",\n".join(f"  {line}" for line in lines)
    file.write_text(
        f'{{\n "schema": "{SCHEMA}",\n "origins": {{\n{words}\n }}\n}}\n', encoding="utf-8"
    )


def record_publication(page: Path, names: Iterable[str], root: Path = ROOT) -> None:
    """Put down that blocks of a page, and its pictures that are new, were made now.

    A page elsewhere than in the checkout, and a checkout without git, have no revision.
    """
    page = page.resolve()
    if not page.is_relative_to(root):
        return
    revision = GitRevision.ask().answer()
    if not revision:
        return
    file = root / LEDGER.relative_to(ROOT)
    ledger = read_ledger(file)
    date = datetime.now(UTC).date().isoformat()
    made = {f"{page.relative_to(root).as_posix()}#{name}" for name in names}
    for key, value in contents(page, root).items():
        known = ledger.get(key)
        is_picture = "#" not in key
        if key in made or (is_picture and (known is None or known.sha256 != value)):
            ledger[key] = Origin(value, revision, date, "publication")
    write_ledger(ledger, file)


def history_of(root: Path = ROOT) -> Ledger:
    """By git: the newest commit in the lines of each block, and the last one of each picture.

    Blocks and pictures that are not committed as they are have none.
    """
    origins: Ledger = {}
    pictures = _last_commits(root)
    for page in pages_of(root):
        name = page.relative_to(root).as_posix()
        blame = _blame(name, root)
        for block in blocks_of(page.read_text(encoding="utf-8")):
            commits = [blame[i] for i in block.lines if i in blame]
            if commits and len(commits) == len(block.lines):
                _, revision, date = max(commits)
                origins[f"{name}#{block.name}"] = Origin(
                    digest(block.text), revision, date, "history"
                )
    for key in pictures_in(root):
        if key in pictures:
            value = digest((root / key).read_bytes())
            origins[key] = Origin(value, *pictures[key], "history")
    return origins


def complete(ledger: Ledger, root: Path = ROOT) -> Ledger:
    """What is put down of what stands in the pages now; else what git knows of it."""
    now = contents_of_all(root)
    origins = {key: o for key, o in ledger.items() if now.get(key) == o.sha256}
    if now.keys() - origins.keys():
        origins |= {key: o for key, o in history_of(root).items() if key not in origins}
    return origins


def _git(root: Path, *words: str) -> str:
    done = subprocess.run(
        ["git", "-C", str(root), *words], capture_output=True, text=True, check=False
    )
    return done.stdout if done.returncode == 0 else ""


def _blame(name: str, root: Path) -> dict[int, tuple[int, str, str]]:
    """Time, revision and date of the commit of each committed line of a file."""
    lines: dict[int, tuple[int, str, str]] = {}
    revision, line, time = "", 0, 0
    for row in _git(root, "blame", "--line-porcelain", "--", name).splitlines():
        if row.startswith("\t"):
            if revision.strip("0"):
                date = datetime.fromtimestamp(time, UTC).date().isoformat()
                lines[line] = (time, revision[:12], date)
        elif row.startswith("committer-time "):
            time = int(row.split()[1])
        else:
            words = row.split()
            if len(words) >= 3 and len(words[0]) == 40 and words[1].isdigit():
                revision, line = words[0], int(words[2])
    return lines


def _last_commits(root: Path) -> dict[str, tuple[str, str]]:
    """Revision and date of the last commit of each picture that is committed as it is."""
    commits: dict[str, tuple[str, str]] = {}
    now = ("", "")
    log = _git(
        root, "log", "--name-only", "--format=%x00%H %cs", "--", "docs/figures", "experiments"
    )
    for row in log.splitlines():
        if row.startswith("\0"):
            revision, date = row[1:].split()
            now = (revision[:12], date)
        elif row.endswith(PICTURES):
            commits.setdefault(row, now)
    changed = _git(root, "status", "--porcelain", "--no-renames", "--", "docs", "experiments")
    for row in changed.splitlines():
        commits.pop(row[3:].strip('"'), None)
    return commits
