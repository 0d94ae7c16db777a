"""The task sheet of a student: what is known of the rig, what is asked, and how to answer."""

from __future__ import annotations

from experiments.course.answers import LISTED, NO_EFFECT, size_of
from experiments.gap.blind.truths import LIBRARY
from trms_cli.composition.catalogue import read_groups
from trms_cli.core import wording
from trms_cli.core.plugins import build
from trms_cli.library.tasks.diagnose import effect_nodes
from trms_cli.models.model import Model
from trms_cli.models.parameters import Parameter

ANSWER, SHEET = "answer.yaml", "task.md"

_SHEET = """\
# {rig}: what does the model lack?

`recording.csv` is a recording of a twin rotor in open loop, {duration:g} s at {rate:g} Hz. It \
holds the commands `u_v` and `u_h` (V), pitch `alpha_v` and yaw `alpha_h` (rad), and the rotor \
speeds `omega_v` and `omega_h` (rad/s). The rig is not quite the one of `model=newtonian`:

- Its parameters may be off, by as much as their priors allow.
- Its sensors are noisy, and its drives wander a little.
- **It may have one effect that the model lacks.** That is what you are to find.

Say which effect of the table the rig has, where it acts, how large it is, and how sure you are of \
the size. If the parameters alone explain the recording, the effect is `{none}`. You fill in \
`answer.yaml`. How you find out is up to you. The first of these commands shows where the gap \
lies, the second fits parameters, the third is a whole diagnosis. Do not believe the third without \
a plot that shows it. The last one tells whether your form can be read.

```sh
trms validate real=recording.csv model=newtonian
trms identify real=recording.csv model=newtonian
trms diagnose real=recording.csv
trms course check answers=answer.yaml
```

| effect | what it is | where it acts | `size` [unit] | known |
|---|---|---|---|---|
{rows}

The effect counts most. One that no recording tells from the true one counts nearly as much. Then \
come the place, the size and its `uncertainty`, which is one standard deviation: the truth should \
lie within two of them, and one that is as large as the size itself says nothing.

The truth was fixed before this sheet was written. The SHA-256 of its key is \
`{commitment}`; the key is opened when all answers are in.
"""

_FORM = """\
# What you found out about {rig}; see task.md. Units are SI.
rig: {rig}
effect:         # a name of the table; {none}: the parameters alone are off, the rest stays empty
place:          # where it acts
size:           # of the effect, in the unit of the table
uncertainty:    # one standard deviation of the size, in the same unit
"""


def task_sheet(rig: str, model: Model, commitment: str, duration: float, sample_time: float) -> str:
    """The sheet of a rig, Markdown.

    Parameters
    ----------
    rig : str
        Its name.
    model : Model
        The nominal one, in whose units effects are.
    commitment : str
        SHA-256 of the key.
    duration, sample_time : float
        Of the recording, s.
    """
    return _SHEET.format(
        rig=rig,
        duration=duration,
        rate=1 / sample_time,
        none=NO_EFFECT,
        rows="\n".join(_row(effect, model) for effect in LISTED),
        commitment=commitment,
    )


def form(rig: str) -> str:
    """The form of a rig, to be filled in."""
    return _FORM.format(rig=rig, none=NO_EFFECT)


def sizes_of(effect: str, model: Model) -> dict[str, Parameter]:
    """All sizes of an effect as they act on a model, by name."""
    built = build(effect_nodes()[effect], f"effect.{effect}").for_model(model)
    return {size.name: size for size in built.parameters()}


def _row(effect: str, model: Model) -> str:
    truth, sizes, asked = LIBRARY[effect], sizes_of(effect, model), size_of(effect)
    places = ", ".join(f"`{at}`" for at in truth.locations)
    known = ", ".join(
        f"{name} {wording.number(value)} {wording.unit(sizes[name].unit)}".rstrip()
        for name, value in truth.sizes.items()
        if value and name in sizes and name not in truth.grows
    )
    unit = wording.unit(sizes[asked].unit) or "1"
    size = f"{asked.replace('_', ' ')} [{unit}]"
    about = read_groups()["effect"][effect].summary
    return f"| `{effect}` | {about} | {places} | {size} | {known} |"
