"""What to type to control with a model that came from recordings of a rig.

The rig that was recorded is to be driven: with ``trms run --from LOG`` it is the log's own,
simulated or real, and the new model is only what controller and observer believe. Where the
recording is no log of a run (a CSV of a lab), only a plant option knows the rig; what
``trms run model=FILE`` simulates is a clone of the model, and is called one.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from trms_cli.composition.arguments import text_of
from trms_cli.composition.composer import Composition, compose
from trms_cli.composition.plain_values import value_at
from trms_cli.core.errors import TrmsError
from trms_cli.core.findings import NextCommand
from trms_cli.core.invocation import program
from trms_cli.core.trust import allowed_for_now
from trms_cli.library.tasks.repeat import LoggedLoop, loop_of
from trms_cli.models.model import Model, names
from trms_cli.runs.run_folder import log_of

#: The controller in which a model decides, and the observer that any model will do for.
CONTROLLER, _OBSERVER = "newton_mpc", "ukf"
#: An observer that reads the state of a simulated rig as it is: it would need the rig's own model.
_TRUE_STATE = "full_state"


def control_commands(
    model: Model,
    file: Path,
    sources: Iterable[str],
    composition: Composition,
    *,
    kind: str,
    words: Sequence[str] = (),
) -> Iterator[NextCommand]:
    """The lines that control with a model.

    Parameters
    ----------
    model, file : Model, Path
        The model and its file.
    sources : iterable of str
        The recordings that it came from, as they were named.
    composition : Composition
        What made it: options of a user's own folders are named again.
    kind : str
        What the model is: ``fitted``, ``corrected``.
    words : sequence of str
        Overrides besides: a reference.
    """
    own = own_options(composition)
    loops = list(_loops(sources))
    believed = f"model={file}"
    for loop in loops:
        if loop.inputs != names(model.inputs):
            continue  # of a single axis, say
        typed = [*_from(loop), f"controller={CONTROLLER}", believed]
        yield NextCommand(
            _line([*typed, *words, *own]),
            f"drives the rig that was recorded; the {kind} model is what the controller believes",
        )
        return
    typed = [believed, f"controller={CONTROLLER}", *words, *own]
    yield NextCommand(
        _line(typed), f"on a simulated clone of the {kind} model, not on the rig that was recorded"
    )
    if not loops:
        yield NextCommand(
            _line(["plant=NAME", *typed]),
            "on the rig itself; NAME is the plant option that drives it (trms list plant)",
        )


def on_recorded_rig(
    command: str, model: Model, sources: Iterable[str], composition: Composition
) -> str:
    """A line that runs an experiment, on the rig that was recorded where a log knows it.

    Of the log's own commands nothing is left in it, and its noise is another.
    """
    words = shlex.split(command)
    loop = next((each for each in _loops(sources) if each.inputs == names(model.inputs)), None)
    if loop is None or words[1:2] != ["run"]:
        return command
    overrides = words[2:]
    try:
        anew = compose(overrides, config_dirs=composition.config_dirs).config
    except TrmsError:
        return command
    places = {word.lstrip("+").partition("=")[0] for word in loop.typed if "@" not in word}
    typed = {word.partition("=")[0] for word in overrides}
    left = [
        f"{place}={text_of(value)}"
        for place in sorted(places - typed)
        if place.startswith("controller.") and (value := value_at(anew, place)) is not None
    ]
    return _line(
        [*_from(loop), *overrides, *left, f"seed={loop.seed + 1}", *own_options(composition)]
    )


def _loops(sources: Iterable[str]) -> Iterator[LoggedLoop]:
    for source in sources:
        loop = loop_of(log_of(Path(source)))
        if loop is not None:
            yield loop


def _from(loop: LoggedLoop) -> list[str]:
    observer = loop.choices.get("observer") == _TRUE_STATE
    return ["--from", str(loop.path), *([f"observer={_OBSERVER}"] if observer else [])]


def own_options(composition: Composition) -> list[str]:
    """Options of one's own, and their classes, as they are named again on a command line."""
    folders = [f"--config-dir={folder}" for folder in composition.config_dirs]
    return [*folders, *(f"--allow={package}" for package in sorted(allowed_for_now()) if folders)]


def _line(words: Sequence[str]) -> str:
    return shlex.join([*program().split(), "run", *words])
