"""``trms stability``: what to know of a model or a closed loop before it flies."""

from collections.abc import Sequence

from trms_cli.commands.execution import execute, help_of_options, study
from trms_cli.composition.composer import Composition, Outcome

SUMMARY = "equilibria, modes, phase portraits, limit cycles, Lyapunov sets, margins"
COMPOSES = "stability"

HELP = """\
usage: trms stability study=NAME [model=NAME|FILE.yaml] [effect=NAME] [controller=NAME]
                      [study.KEY=VALUE]… [-m] [--cfg job] [--config-dir DIR]…

Answers one question about a model, or about the loop that a controller closes around it, and
leaves a folder with the figures as PNG, a page (stability.html) and all numbers (stability.json).
Each answer says whether it is proved, or found by a search, and within which bounds.

examples
  trms stability                                            where the rig can rest, all of it
  trms stability study=local                                modes at rest and over the range
  trms stability study=local study.at.alpha_v=0.4 model=rahideh
  trms stability study=root_locus                           where k_g makes pitch unstable, and why
  trms stability study=root_locus study.over=k_ov study.at.alpha_v=0.3
  trms stability study=controllability                      what each input moves, each sensor sees
  trms stability study=phase_portrait model=newtonian_vertical study.at.alpha_v=0
  trms stability study=phase_portrait controller=pid study.at.alpha_v=0
  trms stability study=limit_cycles model=rahideh study.at.alpha_v=0.17
  trms stability study=hunting controller=pid effect=pitch_stribeck_friction \\
    effect.pitch_stribeck_friction.torque=0.02 effect.pitch_stribeck_friction.velocity=0.01
  trms stability study=lyapunov model=newtonian_vertical    functions of energy, checked
  trms stability study=region_of_attraction model=newtonian_vertical
  trms stability study=margins controller=newton_mpc observer=ukf
  trms stability study=tolerance controller=lqr             delay, gain, friction until it fails
  trms stability -m study=margins controller=lqr,pid,newton_mpc

options
""" + help_of_options("study")


def main(argv: Sequence[str]) -> int:
    """Compose and study."""
    return execute(argv, COMPOSES, perform)


def perform(composition: Composition) -> Outcome:
    """Answer the question of a configuration."""
    from trms_cli.library.tasks.stability import perform as task

    return study("stability", composition, task)
