"""What a run is called: who ran, after which reference, with which model, on which rig."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from trms_cli.core import wording

_FILE = "from_file"


def headline(choices: Mapping[str, str], *, follows: bool = True, rig: str = "") -> str:
    """``lqr · ref square · observer ukf · model fit · plant simulated (newtonian)``.

    ``choices``: as :func:`shown_choices` gives them. ``follows``: whether the controller follows a
    reference. ``rig``: name of the rig's model; "" if it is not known.
    """
    parts = [choices.get("controller", "")]
    parts += [f"ref {choices.get('ref', '')}"] if follows else []
    parts += [f"{group} {choices.get(group, '')}" for group in ("observer", "model")]
    parts.append(f"plant {choices.get('plant', '')}" + (f" ({rig})" if rig else ""))
    chosen = [(group, choices.get(group, "")) for group in ("effect", "fault")]
    parts += [f"{group} {names}" for group, names in chosen if names and names != "none"]
    return " · ".join(parts)


def shown_choices(choices: Mapping[str, Any], config: Mapping[str, Any] | str) -> dict[str, str]:
    """The option of each group as it is called; a model of a file by its file or fit.

    ``choices``: the option chosen in each group, as a log has them. ``config``: the resolved
    configuration, or its YAML, which is read only where it is needed.
    """
    node: Any = config
    if isinstance(config, str):
        node = _loaded(config) if _FILE in choices.values() else {}
    return {
        str(group): wording.option(choice, node.get(group)) if choice else ""
        for group, choice in choices.items()
    }


def _loaded(text: str) -> Mapping[str, Any]:
    import yaml

    from trms_cli.core.yaml_data import load_yaml

    try:
        config = load_yaml(text)
    except yaml.YAMLError:
        return {}
    return config if isinstance(config, Mapping) else {}
