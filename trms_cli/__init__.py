"""trms: a laboratory for the twin rotor MIMO system, on the command line and from Python.

``from trms_cli import run, compare, identify, …`` does what the commands do, with plain arguments;
``docs/library.md`` shows it. Names are imported when they are first asked for, so that
``import trms_cli`` alone costs nothing.
"""

import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

__version__ = "1.0.0"

if TYPE_CHECKING:
    from trms_cli.core.errors import ConfigurationError as ConfigurationError
    from trms_cli.core.errors import RecordingError as RecordingError
    from trms_cli.core.errors import TrmsError as TrmsError
    from trms_cli.library.call import TrmsNote as TrmsNote
    from trms_cli.library.comparison import Comparison as Comparison
    from trms_cli.library.comparison import compare as compare
    from trms_cli.library.comparison import runs as runs
    from trms_cli.library.comparison import score as score
    from trms_cli.library.options import build as build
    from trms_cli.library.options import options as options
    from trms_cli.library.run import Run as Run
    from trms_cli.library.run import read_log as read_log
    from trms_cli.library.run import run as run
    from trms_cli.library.studies import Diagnosis as Diagnosis
    from trms_cli.library.studies import Excitation as Excitation
    from trms_cli.library.studies import Fit as Fit
    from trms_cli.library.studies import Stability as Stability
    from trms_cli.library.studies import Validation as Validation
    from trms_cli.library.studies import diagnose as diagnose
    from trms_cli.library.studies import excite as excite
    from trms_cli.library.studies import identify as identify
    from trms_cli.library.studies import stability as stability
    from trms_cli.library.studies import validate as validate
    from trms_cli.library.sweep import Sweep as Sweep
    from trms_cli.library.sweep import load as load
    from trms_cli.library.sweep import sweep as sweep
    from trms_cli.library.tasks.task import Interrupted as Interrupted
    from trms_cli.library.views import plot as plot
    from trms_cli.library.views import report as report
    from trms_cli.simulation.closed_loop import Experiment as Experiment

#: Module of each name.
_HOMES = {
    "ConfigurationError": "core.errors",
    "RecordingError": "core.errors",
    "TrmsError": "core.errors",
    "Interrupted": "library.tasks.task",
    "TrmsNote": "library.call",
    "build": "library.options",
    "options": "library.options",
    "Diagnosis": "library.studies",
    "Excitation": "library.studies",
    "Fit": "library.studies",
    "Stability": "library.studies",
    "Validation": "library.studies",
    "Comparison": "library.comparison",
    "compare": "library.comparison",
    "load": "library.sweep",
    "runs": "library.comparison",
    "score": "library.comparison",
    "Run": "library.run",
    "read_log": "library.run",
    "run": "library.run",
    "plot": "library.views",
    "report": "library.views",
    "diagnose": "library.studies",
    "excite": "library.studies",
    "identify": "library.studies",
    "stability": "library.studies",
    "validate": "library.studies",
    "Sweep": "library.sweep",
    "sweep": "library.sweep",
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
