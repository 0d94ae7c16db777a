"""The reference of configurations: a page per group, made from the YAML files themselves.

What a group is for and which options it has comes from ``trms list --json``, so that the pages and
the program say the same.
"""

from __future__ import annotations

import contextlib
import io
import json
import re
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml

from . import yaml_keys
from .pages import code, plain, table, toctree

#: Groups whose files hold data rather than keys to be changed one by one.
_DATA = {"networks"}
#: Where the keys of a group stand that is chosen inside another.
_PLACES = {
    "disturbance": "plant.disturbances",
    "networks": "",
    "parameters": "",
    "qp_solver": "controller.qp",
    "shaping": "ref.shaping",
    "signal": "ref.alpha_v",
    "training": "method.training",
}
_LONGEST = 160  # characters of a default in the table


@lru_cache(maxsize=1)
def groups() -> dict[str, Any]:
    """What ``trms list --json`` tells."""
    from trms_cli.commands import list_

    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        list_.main(["--json"])
    found: dict[str, Any] = json.loads(printed.getvalue())["groups"]
    return found


def pages() -> dict[str, str]:
    """A page a group."""
    return {f"{page_name(group)}.md": _page(group, about) for group, about in groups().items()}


def page_name(group: str) -> str:
    """Name of a group's page; a group inside another has a slash."""
    return group.replace("/", "-")


def listing() -> str:
    """The table of groups, and the navigation to them."""
    rows = [
        [
            f"[{group}](configuration/{page_name(group)}.md)",
            plain(about["about"]),
            str(len(about["options"])),
        ]
        for group, about in groups().items()
    ]
    names = [f"configuration/{page_name(group)}" for group in groups()]
    return f"\n{table(['group', 'what it chooses', 'options'], rows)}{toctree(names, depth=1)}"


def _page(group: str, about: dict[str, Any]) -> str:
    options = about["options"]
    parts = [f"# {group}\n"]
    if about["about"]:
        parts.append(_sentence(about["about"]))
    anchors = [f"[{o['name']}](#{_anchor(o['name'])})" for o in options]
    rows = [[a, plain(o["summary"])] for a, o in zip(anchors, options, strict=True)]
    parts.append(table(["option", "what it is"], rows))
    parts += [_option(group, option) for option in options]
    return "\n".join(parts)


def _sentence(text: str) -> str:
    return f"{plain(text[:1].upper() + text[1:])}.\n"


def _anchor(name: str) -> str:
    """The anchor that Markdown gives a heading of this name."""
    return re.sub(r"[^\w\- ]", "", name.lower()).replace(" ", "-")


def _option(group: str, option: dict[str, str]) -> str:
    file = Path(option["file"])
    parts = [f"## {option['name']}\n", f"{plain(option['summary'])}\n"]
    target = yaml_keys.target(file)
    if target:
        parts.append(f"Class {code(target)}.\n")
    place = _PLACES.get(group, group)
    for inner, where, default in yaml_keys.included(file):
        link = f"[{inner}]({page_name(inner)}.md)"
        parts.append(
            f"Includes an option of {link}: {code(f'{inner}@{_joined(place, where)}={default}')}.\n"
        )
    if group == "parameters":
        parts.append(_parameters(file))
    elif group not in _DATA:
        parts.append(key_table(file, place))
        content = file.read_text(encoding="utf-8").rstrip()
        parts.append(
            f"<details><summary>the YAML</summary>\n\n```yaml\n{content}\n```\n\n</details>\n"
        )
    return "\n".join(part for part in parts if part)


def _joined(*words: str) -> str:
    return ".".join(word for word in words if word)


def key_table(file: Path, place: str) -> str:
    """The keys of a YAML as overrides, with default, unit and meaning."""
    rows = [
        [
            code(_joined(place, key.path)),
            code(_short(key.default)),
            plain(key.unit),
            plain(key.meaning),
        ]
        for key in yaml_keys.keys(file)
    ]
    return table(["key", "default", "unit", "meaning"], rows) if rows else ""


def _short(text: str) -> str:
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]} …"


def _parameters(file: Path) -> str:
    """A set of parameters: values, units, priors, bounds, sources."""
    content = yaml.safe_load(file.read_text(encoding="utf-8"))
    parts = []
    source = _sentence(str(content["source"])) if content.get("source") else ""
    parts.append(f"Of the model {code(str(content.get('model', '')))}. {source}\n")
    rows = []
    for name, entry in (content.get("parameters") or {}).items():
        entry = entry if isinstance(entry, dict) else {"value": entry}
        bounds = [entry.get("lower"), entry.get("upper")]
        limits = (
            " … ".join("" if b is None else f"{b:g}" for b in bounds)
            if any(b is not None for b in bounds)
            else ""
        )
        prior = entry.get("prior_sd")
        said = "; ".join(str(entry[k]) for k in ("description", "source") if entry.get(k))
        rows.append([
            code(name),
            f"{float(entry.get('value')):g}",
            plain(str(entry.get("unit") or "")),
            "" if prior is None else f"{100 * float(prior):g} %",
            limits,
            plain(said),
        ])  # fmt: skip
    head = ["parameter", "value", "unit", "prior sd", "bounds", "what it is, source"]
    return "\n".join(parts) + "\n" + table(head, rows)
