"""trms: a laboratory for the twin rotor MIMO system, on the command line and from Python.

``from trms_cli import run, compare, identify, …`` does what the commands do, with plain arguments;
``docs/library.md`` shows it. Names are imported when they are first asked for, so that
``import trms_cli`` alone costs nothing.
"""

import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from trms_cli.core.errors import ConfigurationError as ConfigurationError
    from trms_cli.core.errors import RecordingError as RecordingError
    from trms_cli.core.errors import TrmsError as TrmsError
    from trms_cli.library.calling import TrmsNote as TrmsNote
    from trms_cli.library.choosing import build as build
    from trms_cli.library.choosing import options as options
    from trms_cli.library.findings import Diagnosis as Diagnosis
    from trms_cli.library.findings import Excitation as Excitation
    from trms_cli.library.findings import Fit as Fit
    from trms_cli.library.findings import Stability as Stability
    from trms_cli.library.findings import Validation as Validation
    from trms_cli.library.judging import Comparison as Comparison
    from trms_cli.library.judging import compare as compare
    from trms_cli.library.judging import runs as runs
    from trms_cli.library.judging import score as score
    from trms_cli.library.running import Run as Run
    from trms_cli.library.running import read_log as read_log
    from trms_cli.library.running import run as run
    from trms_cli.library.showing import plot as plot
    from trms_cli.library.showing import report as report
    from trms_cli.library.studying import diagnose as diagnose
    from trms_cli.library.studying import excite as excite
    from trms_cli.library.studying import identify as identify
    from trms_cli.library.studying import stability as stability
    from trms_cli.library.studying import validate as validate
    from trms_cli.library.sweeping import Sweep as Sweep
    from trms_cli.library.sweeping import load as load
    from trms_cli.library.sweeping import sweep as sweep
    from trms_cli.library.tasks.task import Interrupted as Interrupted
    from trms_cli.simulation.closed_loop import Experiment as Experiment

#: Module of each name.
_HOMES = {
    "ConfigurationError": "core.errors",
    "RecordingError": "core.errors",
    "TrmsError": "core.errors",
    "Interrupted": "library.tasks.task",
    "TrmsNote": "library.calling",
    "build": "library.choosing",
    "options": "library.choosing",
    "Diagnosis": "library.findings",
    "Excitation": "library.findings",
    "Fit": "library.findings",
    "Stability": "library.findings",
    "Validation": "library.findings",
    "Comparison": "library.judging",
    "compare": "library.judging",
    "load": "library.sweeping",
    "runs": "library.judging",
    "score": "library.judging",
    "Run": "library.running",
    "read_log": "library.running",
    "run": "library.running",
    "plot": "library.showing",
    "report": "library.showing",
    "diagnose": "library.studying",
    "excite": "library.studying",
    "identify": "library.studying",
    "stability": "library.studying",
    "validate": "library.studying",
    "Sweep": "library.sweeping",
    "sweep": "library.sweeping",
    "Experiment": "simulation.closed_loop",
}

__all__ = ["__version__", *_HOMES]


#: Rooms of the program that have a function's name: they are called like that function.
_BOTH = ("runs", "stability")


def _function(name: str) -> Any:
    from importlib import import_module

    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if name in _BOTH:
        from importlib import import_module

        return import_module(f"{__name__}.{name}")
    return _function(name)


def __dir__() -> list[str]:
    return sorted(__all__)


class _CallableRoom(ModuleType):
    """A room that is called like the function of its name, with that function's help."""

    __call__ = property(lambda self: _function(self.__name__.rpartition(".")[2]))
    __signature__ = property(lambda self: __import__("inspect").signature(self.__call__))


class _Package(ModuleType):
    """Importing a room puts it here as an attribute, where a function's name may be meant."""

    def __setattr__(self, name: str, value: object) -> None:
        if name in _BOTH and isinstance(value, ModuleType):
            value.__class__ = _CallableRoom
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
