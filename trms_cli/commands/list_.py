"""``trms list``: the plugins and settings that can be chosen by name."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from trms_cli.commands.catalogue import (
    Groups,
    Option,
    read_groups,
    read_primary,
    row,
    take_config_dirs,
)
from trms_cli.core.errors import EXIT_OK, ConfigurationError
from trms_cli.core.resources import config_folder

SUMMARY = "the plugins there are, with one line each"

HELP = """\
usage: trms list [GROUP [OPTION]] [--json] [--config-dir DIR]…

  The groups, their options and what each is. With an OPTION: its YAML, whose comments tell
  every key's unit and meaning; each key can be changed as GROUP.KEY=VALUE.

  --json             the same as JSON (schema trms.list/1)
  --config-dir DIR   also your own folder of groups; an option in it hides a built-in namesake

examples
  trms list                    everything
  trms list controller         the controllers
  trms list controller pid     the keys of one
"""

#: Primary configurations; what an earlier one says of a group counts.
_PRIMARIES = ("run", "identify", "validate", "excite", "stability", "sweep")

#: Groups that the primary configurations do not have: they are chosen inside others.
_INSIDE_OTHERS = {
    "disturbance": "torques on the rig: disturbance@plant.disturbances=NAME",
    "parameters": "values of a model: model.parameter_set=NAME",
    "networks": "trained networks of the models narx_…: model.network=NAME",
    "qp_solver": "of newton_mpc: qp_solver@controller.qp=NAME",
    "shaping": "smooths a reference: shaping@ref.shaping=NAME",
    "training": "of a network: training@method.training=NAME",
    "signal": "what one axis follows: signal@ref.alpha_v=NAME",
}


def main(argv: Sequence[str]) -> int:
    """Print groups, one group, or one option."""
    config_dirs, rest = take_config_dirs(argv)
    as_json = "--json" in rest
    words = [word for word in rest if word != "--json"]
    _refuse_options(words)
    groups = read_groups(config_dirs)
    if len(words) >= 2:
        option = find_option(groups, *words[:2])
        if as_json:
            _print_json({option.group: {option.name: option}}, about(config_dirs))
        else:
            sys.stdout.write(f"# {option.file}\n{option.file.read_text(encoding='utf-8')}")
        return EXIT_OK
    if words:
        groups = {words[0]: find_group(groups, words[0])}
    if as_json:
        _print_json(groups, about(config_dirs))
    else:
        sys.stdout.write(_table(groups, about(config_dirs), config_dirs))
    return EXIT_OK


def _refuse_options(words: Sequence[str]) -> None:
    unknown = next((word for word in words if word.startswith("-")), None)
    if unknown is not None or len(words) > 2:
        raise ConfigurationError(
            f"cannot use {(unknown or words[-1])!r}",
            where="trms list",
            remedy="usage: trms list [GROUP [OPTION]] [--json] [--config-dir DIR]",
        )


def find_group(groups: Groups, name: str) -> dict[str, Option]:
    """The options of a group.

    Raises ConfigurationError if there is no such group; it names the nearest.
    """
    from trms_cli.core.plugins import nearest

    if name not in groups:
        raise ConfigurationError(
            f"there is no group {name!r}", where="trms list", remedy=nearest(name, groups)
        )
    return groups[name]


def find_option(groups: Groups, group: str, name: str) -> Option:
    """An option of a group.

    Raises ConfigurationError if there is none; it names the nearest.
    """
    from trms_cli.core.plugins import nearest

    options = find_group(groups, group)
    if name not in options:
        raise ConfigurationError(
            f"group {group} has no option {name!r}",
            where="trms list",
            remedy=nearest(name, options),
        )
    return options[name]


def about(config_dirs: Sequence[Path]) -> dict[str, str]:
    """What each group is for, as the primary configurations' defaults tell it."""
    about = dict(_INSIDE_OTHERS)
    for primary in reversed(_PRIMARIES):
        if (config_folder() / f"{primary}.yaml").is_file():
            about |= read_primary(primary, config_dirs).about
    return about


def _table(groups: Groups, about: dict[str, str], config_dirs: Sequence[Path]) -> str:
    width = max((len(name) for options in groups.values() for name in options), default=0) + 2
    blocks = []
    for group, options in groups.items():
        purpose = about.get(group, "")
        lines = [row(f"{group}  ", f"({purpose})") if purpose else group]
        for option in options.values():
            own = f"  [{option.source}]" if option.source in config_dirs else ""
            lines.append(row(f"  {option.name:{width}}", option.summary + own))
        blocks.append("\n".join(lines) + "\n")
    return "\n".join(blocks)


def document_of(groups: Groups, about: dict[str, str]) -> dict[str, Any]:
    """``trms.list/1``: groups with their options."""
    return {
        "schema": "trms.list/1",
        "groups": {
            group: {
                "about": about.get(group, ""),
                "options": [
                    {"name": option.name, "summary": option.summary, "file": str(option.file)}
                    for option in options.values()
                ],
            }
            for group, options in groups.items()
        },
    }


def _print_json(groups: Groups, about: dict[str, str]) -> None:
    import json

    document = document_of(groups, about)
    sys.stdout.write(json.dumps(document, ensure_ascii=False, indent=2) + "\n")
