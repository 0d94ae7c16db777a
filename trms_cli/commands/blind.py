"""``trms blind``: sealed sets of rigs, their diagnoses, and the judgement."""

from __future__ import annotations

from collections.abc import Sequence

from trms_cli.commands.source_checkout import CheckoutCommand

SUMMARY = "prove diagnoses on sealed rigs: make a set, diagnose it, open its key"

HELP = """\
usage: trms blind make set=NAME out=DIR [seed=N] [cases=N] [KEY=VALUE]…
       trms blind run in=DIR out=DIAGNOSES [effort=normal] [jobs=2] [KEY=VALUE]…
       trms blind score in=DIR diagnoses=DIAGNOSES [key=DIR.key] [KEY=VALUE]…

`make` builds rigs from other code than the models and records them. The truth of each goes into
a key in another folder, DIR.key; its SHA-256 is told first and kept with the recordings. `run`
diagnoses every recording and never opens the key; interrupted and called again, it goes on.
`score` opens the key, checks that it is the one that was told, and prints how often the effect,
its place and its size were found, with 95 % intervals, beside what is to be reached.

sets
  small             24 rigs, some minutes
  development       200 rigs to tune on
  final             300 rigs that lie elsewhere and have effects that development lacks
  imperfect         120 rigs whose laws are others than the model's, with a cause on top
  imperfect_curves  60 rigs whose laws no power describes, with a cause on top
  calibration       1000 rigs that probabilities are fitted to
  course            30 rigs as `trms course` gives them to students
  own               with model=NAME: 96 rigs drawn from a model of your own, with the effects that
                    are generated for it; how large they have to be is measured first

examples
  trms blind make set=small seed=7 out=sets/small
  trms blind run in=sets/small out=sets/found
  trms blind run in=sets/small out=sets/quick effort=quick cases=5
  trms blind run in=sets/small out=sets/few 'with=["candidates=[yaw_*,main_*]"]'
  trms blind score in=sets/small diagnoses=sets/found
  trms blind make model=my_rig data=my_rig fresh=0 out=sets/mine     in the folder of trms init
  trms blind run in=sets/mine out=sets/mine.found                    likewise
  trms blind score in=sets/small 'diagnoses=[full=sets/found,quick=sets/quick]'

options of each of the three
  --cfg job          print its keys with their values and stop
  --config-dir DIR   a folder with option files of your own, searched first (may be repeated)
  --allow PACKAGE    let classes of your own package run in this call (for good: trms allow)
"""

_COMMAND = CheckoutCommand(
    name="blind",
    what="the proof on sealed rigs",
    package="experiments.gap.blind",
    words=("make", "run", "score"),
    paths=("in", "out", "key", "diagnoses"),
    otherwise="; or all three by make blind",
)


def main(argv: Sequence[str]) -> int:
    """Do the one of the three that is asked for."""
    return _COMMAND.main(argv)
