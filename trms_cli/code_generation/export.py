"""A controller as a folder of C: source, header, example, Makefile, README."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from trms_cli import __version__
from trms_cli.code_generation.example_run import example_csv, example_rows
from trms_cli.code_generation.measure import Measured
from trms_cli.code_generation.newton_source import (
    ControllerSource,
    check_exportable,
    named,
    newton_source,
)
from trms_cli.code_generation.observer_source import ObserverSource, observer_source
from trms_cli.code_generation.readme import readme
from trms_cli.controllers.controller import ControlSetup
from trms_cli.controllers.newton_mpc import NewtonMpc
from trms_cli.observers.observer import ObserverSetup
from trms_cli.observers.recursive_filter import RecursiveFilter
from trms_cli.references.trajectory import ReferenceTrajectory

_TEMPLATES = Path(__file__).parent


@dataclass(frozen=True)
class Export:
    """What is written."""

    name: str  #: Prefix of all names in C
    setup: ControlSetup
    controller: NewtonMpc
    source: ControllerSource
    observer: ObserverSource | None
    #: Content by file name; the README comes last, by :meth:`readme`
    files: dict[str, str] = field(default_factory=dict)

    def readme(self, command: str, measured: Measured | None) -> str:
        """The README, with what was measured if it was."""
        return readme(self, command, measured)

    def document(self, command: str, measured: Measured | None) -> dict[str, Any]:
        """The same figures for programs."""
        return {
            "schema": "trms.export-controller/1",
            "version": __version__,
            "command": command,
            "name": self.name,
            "model": self.setup.model.name,
            "control_period_s": self.source.period,
            "sizes": self.source.sizes,
            "observer": None
            if self.observer is None
            else {"channels": self.observer.channels, "sample_time_s": self.observer.period},
            "measured": None if measured is None else asdict(measured),
        }


def export(
    controller: Any,
    setup: ControlSetup,
    reference: ReferenceTrajectory,
    *,
    name: str,
    samples: int,
    observer: Any = None,
    observing: ObserverSetup | None = None,
) -> Export:
    """The files of a controller in C.

    Parameters
    ----------
    controller, observer
        As a closed loop has them; the observer goes along if it is a filter.
    setup : ControlSetup
    reference : ReferenceTrajectory
        Followed in the samples that come with it.
    name : str
        A C identifier, in small letters.
    samples : int
        Control periods in them.
    observing : ObserverSetup, optional
        Channels and noise that the observer is made for.

    Raises
    ------
    ConfigurationError
        For what has no C.
    """
    check_exportable(controller)
    part = None
    if isinstance(observer, RecursiveFilter) and observing is not None:
        part = observer_source(observer, observing)
    title = f"Newton MPC of model {setup.model.name}, by trms {__version__}"
    source = newton_source(controller, setup, name, title, part)
    rows = example_rows(controller, setup, reference, samples)
    example = _template("example.c")
    for token, words in {
        "MPC_OBSERVER_FUNCTION\n": "" if part is None else _template("example_observer.c"),
        "MPC_OBSERVER_CALL\n": "" if part is None else "    time_observer();\n",
    }.items():
        example = example.replace(token, words)
    files = {
        f"{name}.c": source.source,
        f"{name}.h": source.header,
        f"{name}_example.c": named(example, name),
        "Makefile": named(_template("example.mk"), name).replace("mpc.", f"{name}."),
        "example.csv": example_csv(rows, setup, controller.preview(setup)),
    }
    return Export(name, setup, controller, source, part, files)


def _template(file: str) -> str:
    return (_TEMPLATES / file).read_text(encoding="utf-8")
