"""``trms excite``: design signals that show a rig's dynamics."""

from collections.abc import Sequence

from trms_cli.commands.execution import execute, help_of_options, study
from trms_cli.composition.composer import Composition, Outcome

SUMMARY = "design an excitation: band and amplitude from the model"
COMPOSES = "excite"

HELP = """\
usage: trms excite [excitation=KIND] [model=NAME] [KEY=VALUE]… [--cfg job] [--config-dir DIR]…

Designs commands that show a rig's dynamics and keep it within its bounds, and leaves a folder
with the commands (excitation.csv), the figures (excitation.json) and a page of what they excite
(excitation.html, excitation.png): spectra over the noise, and where the rig goes.

The band goes from a fifth of the model's slowest pole to five times its fastest. The amplitudes
are the largest with which the simulated rig stays within a share of its stops. The inputs are
unlike one another: interleaved frequencies, shifted sequences. The picture and the ranges are
those of the model; ranges of rigs drawn from the parameters' priors stand beside them.

examples
  trms excite                                          multisine of low peak, model=newtonian
  trms excite excitation=prbs duration=300             two levels
  trms excite excitation=multilevel reversals=true     rotors that change their direction
  trms excite 'operating_point={alpha_v: 0.1}'         rad, where the excitation is centred
  trms excite 'bounds={alpha_v: 0.5, alpha_h: 1}'      rad, what the angles must not exceed
  trms excite band.lowest=0.05 band.highest=1          Hz
  trms excite excitation.periods=4                     the same period four times
  trms excite model=newtonian_vertical                 one rotor only

then
  trms run controller=played controller.u_v.file=…/excitation.csv sim.duration=140

options
""" + help_of_options("excitation")


def main(argv: Sequence[str]) -> int:
    """Compose and design."""
    return execute(argv, COMPOSES, perform)


def perform(composition: Composition) -> Outcome:
    """Design one composed excitation; write, print and draw it."""
    from trms_cli.library.tasks.excite import perform as task

    return study("excite", composition, task)
