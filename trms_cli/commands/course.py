"""``trms course``: sealed rigs for the students of a course, and marks for their answers."""

from __future__ import annotations

from collections.abc import Sequence

from trms_cli.commands.source_checkout import CheckoutCommand

SUMMARY = "a sealed rig for each student, and marks for what they hand in"

HELP = """\
usage: trms course rigs out=FOLDER [n=30] [seed=N] [KEY=VALUE]…
       trms course check in=FOLDER answers=FOLDER [key=FOLDER.key] [KEY=VALUE]…
       trms course check answers=FILE

`rigs` gives each student a rig of other code than the models: a folder with its recording, a task
sheet and a form. Most rigs have one effect that the model lacks; a few have none, their parameters
alone are off. What is true goes into a key in another folder, FOLDER.key, which stays with you.
`check` opens the key and marks the forms that were handed in: the effect (right, or one that no
recording tells from it), its place, its size, and whether the uncertainty was honest. Without `in`
it reads the forms alone: so students see that theirs is readable before they hand it in.

examples
  trms course rigs n=30 out=rigs                  rigs/rig_001 … and rigs.key
  trms course rigs n=30 seed=71823 out=rigs       the same rigs again; the number is a secret
  trms course check answers=rigs/rig_007/answer.yaml
  trms course check in=rigs answers=handed_in out=marks
  trms course check in=rigs answers=handed_in size_within=0.2 points.place=0

options of both
  --cfg job          print its keys with their values and stop
  --config-dir DIR   a folder with option files of your own, searched first (may be repeated)
  --allow PACKAGE    let classes of your own package run in this call (for good: trms allow)
"""

_COMMAND = CheckoutCommand(
    name="course",
    what="what students' rigs are made of",
    package="experiments.course",
    words=("rigs", "check"),
    paths=("in", "out", "key", "answers"),
)


def main(argv: Sequence[str]) -> int:
    """Do the one of the two that is asked for."""
    return _COMMAND.main(argv)
