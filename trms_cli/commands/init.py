"""``trms init``: a folder for a rig of one's own."""

import sys
from collections.abc import Sequence
from pathlib import Path

from trms_cli.commands.plain_options import PlainOptions
from trms_cli.core.errors import EXIT_OK
from trms_cli.core.invocation import program

SUMMARY = "a folder for a rig of your own: model, driver, configuration, tests, CI"

HELP = """\
usage: trms init NAME [--example servo_drive]

Writes a folder with what a rig of yours needs: a package with its model (twenty lines of equations
to replace) and a driver for its card, a folder of options that trms finds by itself in there, a
Makefile, a test, a workflow for CI. NAME is the folder and the package in it: my_rig, or
lab/my_rig. The package is allowed to run, as `trms allow` does.

  --example NAME   what the equations are to begin with
                     servo_drive   one current, one position (the default)
                     cart_pole     a force on a cart that carries a pendulum, unstable upright

examples
  trms init my_rig
  cd my_rig && make run
  trms diagnose real=rig.csv      in that folder: your model, your options
"""


def main(argv: Sequence[str]) -> int:
    """Write the folder, and tell what to type next."""
    from trms_cli.library.new_rig import new_rig

    parser = PlainOptions("trms init", HELP)
    parser.add_argument("name")
    parser.add_argument("--example", default="servo_drive")
    arguments = parser.parse_args(argv)
    rig = new_rig(Path(arguments.name), arguments.example)
    called = program()
    lines = [
        f"{len(rig.files)} files in {arguments.name}",
        f"  {rig.package}/model.py   the equations: put your rig's in their place",
        f"  {rig.package}/driver.py  its card",
        "  configs/    options; trms finds them in this folder by itself",
        "  README.md   what else there is",
    ]
    if rig.allowed:
        lines.append(f"allowed to run: {rig.package} ({called} allow --remove {rig.package})")
    lines += ["then", f"  cd {arguments.name}"]
    if not rig.allowed:
        lines.append(f"  export TRMS_ALLOW={rig.package}   the list of allowed packages is locked")
    lines += [f"  {called} run", "  make"]
    sys.stdout.write("\n".join(lines) + "\n")
    return EXIT_OK
