"""``trms list``: the plugins and settings that can be chosen by name."""

import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from trms_cli.commands.plain_options import as_options
from trms_cli.composition import catalogue
from trms_cli.core.errors import EXIT_OK, ConfigurationError
from trms_cli.core.printable import print_json

SUMMARY = "the plugins there are, with one line each"

HELP = """\
usage: trms list [GROUP [OPTION]] [--all] [--json] [--config-dir DIR]…

  The groups, or a group's options and what each is. With an OPTION: its YAML, whose comments
  tell every key's unit and meaning; each key can be changed as GROUP.KEY=VALUE.

  --all              all groups with their options
  --json             the same as JSON (schema trms.list/1)
  --config-dir DIR   also your own folder of groups; an option in it hides a built-in namesake

examples
  trms list                    the groups
  trms list --all              the groups with all of their options
  trms list controller         the controllers
  trms list controller pid     the keys of one
"""


def main(argv: Sequence[str]) -> int:
    """Print groups, one group, or one option."""
    config_dirs, rest = catalogue.take_config_dirs(
        as_options(argv, {"json": False, "all": False, "config-dir": True})
    )
    as_json = "--json" in rest
    words = [word for word in rest if word not in ("--json", "--all")]
    _refuse_options(words)
    groups = catalogue.read_groups(config_dirs)
    if len(words) >= 2:
        option = catalogue.find_option(groups, *words[:2])
        if as_json:
            selection = {option.group: {option.name: option}}
            print_json(document_of(selection, catalogue.about(config_dirs)))
        else:
            sys.stdout.write(f"# {option.file}\n{option.file.read_text(encoding='utf-8')}")
        return EXIT_OK
    if words:
        groups = {words[0]: catalogue.find_group(groups, words[0])}
    if as_json:
        print_json(document_of(groups, catalogue.about(config_dirs)))
    elif words or "--all" in rest:
        sys.stdout.write(_table(groups, catalogue.about(config_dirs), config_dirs))
    else:
        sys.stdout.write(_overview(groups, catalogue.about(config_dirs)))
    return EXIT_OK


def _refuse_options(words: Sequence[str]) -> None:
    unknown = next((word for word in words if word.startswith("-")), None)
    if unknown is not None or len(words) > 2:
        raise ConfigurationError(
            f"cannot use {(unknown or words[-1])!r}",
            where="trms list",
            remedy="usage: trms list [GROUP [OPTION]] [--json] [--config-dir DIR]",
        )


def _overview(groups: catalogue.Groups, purposes: dict[str, str]) -> str:
    """A line for each group: how many options it has, and what they are for."""
    width = max(map(len, groups), default=0) + 2
    lines = [
        row(f"{group:{width}}{len(options):3}  ", purposes.get(group, ""))
        for group, options in groups.items()
    ]
    return "\n".join([*lines, "", "next  trms list GROUP", "      trms list --all", ""])


def _table(groups: catalogue.Groups, purposes: dict[str, str], config_dirs: Sequence[Path]) -> str:
    width = max((len(name) for options in groups.values() for name in options), default=0) + 2
    blocks = []
    for group, options in groups.items():
        purpose = purposes.get(group, "")
        lines = [row(f"{group}  ", f"({purpose})") if purpose else group]
        for option in options.values():
            own = f"  [{option.source}]" if option.source in config_dirs else ""
            lines.append(row(f"  {option.name:{width}}", option.summary + own))
        blocks.append("\n".join(lines) + "\n")
    return "\n".join(blocks)


def document_of(groups: catalogue.Groups, purposes: dict[str, str]) -> dict[str, Any]:
    """``trms.list/1``: groups with their options."""
    return {
        "schema": "trms.list/1",
        "groups": {
            group: {
                "about": purposes.get(group, ""),
                "options": [
                    {"name": option.name, "summary": option.summary, "file": str(option.file)}
                    for option in options.values()
                ],
            }
            for group, options in groups.items()
        },
    }


def describe_choices(primary: str, config_dirs: Sequence[Path] = ()) -> str:
    """The part of a command's help that tells which groups and options its overrides choose."""
    declared = catalogue.read_primary(primary, config_dirs)
    groups = catalogue.read_groups(config_dirs)
    lines = ["choices (the default is marked *; `trms list GROUP OPTION` shows an option's keys)"]
    for group, default in declared.defaults.items():
        lines.append(row(f"  {group:12}", declared.about.get(group, "")))
        for name, option in groups.get(group, {}).items():
            mark = "*" if name == default else " "
            lines.append(row(f"   {mark} {name:24} ", option.summary))
    lines += ["", "other keys", *_key_lines(catalogue.primary_file(primary, config_dirs))]
    return "\n".join(lines) + "\n"


def describe_groups(primary: str, command: str) -> str:
    """What can be chosen, a line for each group: its default, what it is, how many there are."""
    declared = catalogue.read_primary(primary)
    groups = catalogue.read_groups()
    lines = ["choices, each with its default"]
    for group, default in declared.defaults.items():
        count = len(groups.get(group, {}))
        about = declared.about.get(group, "").split(": [NAME")[0]
        chosen = f"{group}={default or 'none' if not isinstance(default, list) else 'none'}"
        lines.append(row(f"  {chosen:30} ", f"{about} ({count})"))
    return "\n".join(
        [
            *lines,
            "",
            "more",
            row(f"  trms {command} --help-all".ljust(29), "all examples, options and keys"),
            "  trms list GROUP [OPTION]   the options of a group, the keys of an option",
            "",
        ]
    )


def row(head: str, text: str) -> str:
    """One line of a table; on a terminal that is narrower, `text` goes on under itself."""
    if not sys.stdout.isatty():
        return f"{head}{text}".rstrip()
    import shutil
    import textwrap

    width = max(shutil.get_terminal_size().columns - len(head), 20)
    margin = f"\n{' ' * len(head)}"
    return (head + margin.join(textwrap.wrap(text, width, break_on_hyphens=False))).rstrip()


def _key_lines(file: Path) -> list[str]:
    """The own keys of a primary configuration as its file has them, comments included."""
    text = file.read_text(encoding="utf-8").splitlines()
    after = next((i for i, line in enumerate(text) if re.match(r"defaults\s*:", line)), -1) + 1
    body = next((i for i in range(after, len(text)) if re.match(r"\w", text[i])), len(text))
    return [f"  {line}" for line in text[body:] if line.strip()]
