"""The reference of commands: a page each, made from the help that the program prints."""

from __future__ import annotations

import os

from . import configuration
from .pages import code, plain, table, toctree


def pages() -> dict[str, str]:
    """A page a command."""
    from trms_cli.cli import COMMANDS

    return {f"{name}.md": _page(name, summary) for name, summary in COMMANDS.items()}


def listing() -> str:
    """The table of commands, and the navigation to them."""
    from trms_cli.cli import COMMANDS

    rows = [[f"[trms {name}](commands/{name}.md)", plain(s)] for name, s in COMMANDS.items()]
    names = [f"commands/{name}" for name in COMMANDS]
    return f"\n{table(['command', 'what it does'], rows)}{toctree(names, depth=1)}"


def _page(name: str, summary: str) -> str:
    from trms_cli.cli import load_command

    module = load_command(name)
    parts = [f"# trms {name}\n", f"{plain(summary[:1].upper() + summary[1:])}.\n"]
    parts.append(f"```text\n{str(module.HELP).strip()}\n```\n")
    sweeps = "--multirun" in module.HELP
    for primary in _primaries(name, getattr(module, "COMPOSES", None), sweeps=sweeps):
        parts.append(_composition(primary, alone=primary == name.replace("-", "_")))
    return "\n".join(parts)


def _primaries(name: str, composes: str | None, *, sweeps: bool) -> list[str]:
    """The primary configurations of a command: `blind` has one for each of its three words, and
    what takes many values at once (``-m``) has that of sweeps too."""
    from trms_cli.core.resources import config_folder

    word = name.replace("-", "_")
    inner = sorted(file.stem for file in config_folder().glob(f"{word}_*.yaml"))
    own = [composes] if composes else inner
    return [*own, "sweep"] if sweeps and "sweep" not in own else own


def _composition(primary: str, *, alone: bool) -> str:
    from trms_cli.composition.catalogue import primary_file, read_primary

    declared = read_primary(primary)
    title = "" if alone else f" of {primary.replace('_', ' ')}"
    parts = []
    rows = [
        [_group_link(group), _default(chosen), plain(declared.about.get(group, ""))]
        for group, chosen in declared.defaults.items()
    ]
    if rows:
        parts += [
            f"## What can be chosen{title}\n",
            table(["group", "default", "what it is"], rows),
        ]
    keys = configuration.key_table(primary_file(primary), "")
    if keys:
        parts += [f"## Keys{title}\n", keys]
    return "\n".join(parts)


def _group_link(group: str) -> str:
    known = group.partition("@")[0].lstrip("/")
    if known not in configuration.groups():
        return code(group)
    here = os.path.join("..", "configuration", f"{configuration.page_name(known)}.md")
    return f"[{group}]({here})"


def _default(chosen: object) -> str:
    if chosen is None or chosen == []:
        return "none"
    return (
        ", ".join(code(str(c)) for c in chosen) if isinstance(chosen, list) else code(str(chosen))
    )
