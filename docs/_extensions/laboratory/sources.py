"""Links to files of the repository: the site shows each linked file on a page of its own.

In the Markdown such a link is an ordinary relative one (``../configs/run.yaml``), which code hosts
and editors follow; on the site it leads to ``source/configs/run.yaml.html``. A linked folder is
shown as the list of its files, a Markdown file as the page that it is.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

_LINK = re.compile(r"\]\((?![a-z]+:|#|/)([^)\s#]+)(#[^)\s]*)?\)")
_FENCE = re.compile(r"(^```.*?^```[ \t]*$)", re.MULTILINE | re.DOTALL)
_LANGUAGES = {".py": "python", ".yaml": "yaml", ".json": "json", ".md": "markdown", ".c": "c",
              ".toml": "toml", ".sh": "bash", ".csv": "text", ".yml": "yaml"}  # fmt: skip
_OWN = (".md", ".ipynb")


def pages(docs: Path) -> dict[str, str]:
    """A page for every file and folder that a page of the docs links, and those in the folders."""
    wanted: dict[str, Path] = {}
    for page in _markdown(docs):
        for target in _targets(page):
            file = _source(target, page.parent, docs)
            if file is not None:
                wanted[_name(file, docs)] = file
    for file in list(wanted.values()):
        inside = _listed(file) if file.is_dir() else _linked_by(file, docs)
        wanted |= {_name(inner, docs): inner for inner in inside}
    return {f"{name}.md": _page(file, docs) for name, file in sorted(wanted.items())}


def relink(text: str, name: str, docs: Path) -> str:
    """A page whose links to source files lead to their pages on the site."""
    if name.startswith("source/"):
        return text
    folder = (docs / name).parent

    def replaced(match: re.Match[str]) -> str:
        file = None if _is_image(match) else _source(match[1], folder, docs)
        if file is None:
            return match[0]
        return f"](/source/{_name(file, docs)}.md)"

    parts = _FENCE.split(text)
    return "".join(part if part.startswith("```") else _LINK.sub(replaced, part) for part in parts)


def _markdown(docs: Path) -> list[Path]:
    made = docs / "source"
    return [page for page in sorted(docs.rglob("*.md")) if made not in page.parents]


def _linked_by(file: Path, docs: Path) -> list[Path]:
    """What a Markdown file from elsewhere links, as far as it is no page of the site."""
    if file.suffix != ".md":
        return []
    found = [_source(target, file.parent, docs) for target in _targets(file)]
    return [inner for inner in found if inner is not None]


def _targets(page: Path) -> list[str]:
    """What a page links, images and code left out."""
    parts = _FENCE.split(page.read_text(encoding="utf-8"))
    text = "".join(part for part in parts if not part.startswith("```"))
    return [match[1] for match in _LINK.finditer(text) if not _is_image(match)]


def _is_image(match: re.Match[str]) -> bool:
    """Whether a link's bracket was opened behind an exclamation mark."""
    depth, text = 0, match.string
    for place in range(match.start(), -1, -1):
        depth += {"]": 1, "[": -1}.get(text[place], 0)
        if depth == 0:
            return text[place - 1 : place] == "!"
    return False


def _source(target: str, folder: Path, docs: Path) -> Path | None:
    """The file that a relative link names, where it is no page of the site."""
    file = Path(os.path.normpath(folder / target))
    inside = docs in file.parents
    if inside and file.suffix in (*_OWN, ".png", ".svg") and "example_plugin" not in file.parts:
        return None
    return file if file.exists() and docs.parent in file.parents else None


def _name(file: Path, docs: Path) -> str:
    return file.relative_to(docs.parent).as_posix()


def _listed(folder: Path) -> list[Path]:
    kept = sorted(file for file in folder.rglob("*") if file.is_file())
    return [file for file in kept if "__pycache__" not in file.parts and file.suffix != ".pyc"]


def _page(file: Path, docs: Path) -> str:
    name = _name(file, docs)
    head = f"{_head(orphan=True)}# {file.name}\n\n`{name}`\n\n"
    if file.is_dir():
        items = [
            f"- [{inner.relative_to(file).as_posix()}](/source/{_name(inner, docs)}.md)"
            for inner in _listed(file)
        ]
        return head + "\n".join(items) + "\n"
    text = file.read_text(encoding="utf-8", errors="replace")
    if file.suffix == ".md":
        return _head(orphan=False) + _as_page(text, file, docs)
    longest = max((len(run) for run in re.findall(r"`{3,}", text)), default=2)
    fence = "`" * (longest + 1)
    language = _LANGUAGES.get(file.suffix, "text")
    return f"{head}{fence}{language}\n{text.rstrip()}\n{fence}\n"


def _head(*, orphan: bool) -> str:
    """Front matter: pages of code are no part of the navigation, and nothing to search."""
    return "---\norphan: true\nnosearch: true\n---\n\n" if orphan else "---\norphan: true\n---\n\n"


def _as_page(text: str, file: Path, docs: Path) -> str:
    """A Markdown file from elsewhere, its links made to lead from the site."""

    def replaced(match: re.Match[str]) -> str:
        target = Path(os.path.normpath(file.parent / match[1]))
        if _is_image(match):
            return f"]({os.path.relpath(target, (docs / 'source' / _name(file, docs)).parent)})"
        if target.suffix == ".md" and docs in target.parents:
            return f"](/{target.relative_to(docs).as_posix()}{match[2] or ''})"
        return "]" if not target.exists() else f"](/source/{_name(target, docs)}.md)"

    return _LINK.sub(replaced, text)
