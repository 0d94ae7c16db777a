"""Every command that may name classes of a user's package tells how to let them run."""

from __future__ import annotations

import pytest

from trms_cli.cli import COMMANDS, load_command


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_that_composes_tells_allow(name: str) -> None:
    command = load_command(name)
    if hasattr(command, "COMPOSES") or "--config-dir" in command.HELP:
        assert "--allow" in command.HELP or name in ("allow", "list"), name


def test_the_example_with_a_folder_of_plugins_allows_them() -> None:
    for line in load_command("run").HELP.splitlines():
        if "--config-dir mylab" in line:
            assert "--allow" in line
