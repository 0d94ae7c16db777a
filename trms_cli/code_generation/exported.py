"""The exported controller and its observer as plugins: their C decides in the loop's own place.

``trms rig drive --exported FOLDER`` runs the loop of ``trms run`` with what ``trms
export-controller`` wrote: the source is compiled, and called sample by sample in the order in which
a rig's own computer calls it (README.md of the folder). Only a folder that this command was given
is compiled: a configuration or a log that names one runs nothing.
"""

from __future__ import annotations

import ctypes
import functools
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from trms_cli.code_generation.observer_source import template
from trms_cli.controllers.controller import Command, ControlSample, ControlSetup, Delay
from trms_cli.controllers.fallback import end_of_run
from trms_cli.controllers.newton import engine, source
from trms_cli.controllers.newton.engine import EngineContext, EngineLibrary
from trms_cli.core.arrays import FloatArray
from trms_cli.core.c_source import with_prefix
from trms_cli.core.compilation import build_library, compiler
from trms_cli.core.data_file import read_bytes, read_json
from trms_cli.core.errors import ConfigurationError
from trms_cli.core.trust import check_export
from trms_cli.models.estimate import Estimate
from trms_cli.models.model import Model, names
from trms_cli.observers.observer import ObserverSetup

#: Written beside the source by ``trms export-controller``.
DOCUMENT_NAME = "controller.json"
_SCHEMA = "trms.export-controller/1"
_NAME = re.compile(r"[a-z][a-z0-9_]{0,30}")
#: Bytes of a source or a header; an export that is larger is refused when it is made.
_LARGEST_SOURCE = 64 * 2**20
_REMEDY = "a folder that `trms export-controller` wrote, with NAME.c, NAME.h and controller.json"
_Pointer = ctypes.POINTER(ctypes.c_double)


@dataclass(frozen=True)
class ExportFolder:
    """What lies in a folder that ``trms export-controller`` wrote."""

    path: Path
    name: str  #: Prefix of all names in C
    period: float  #: s, of the controller
    channels: tuple[str, ...]  #: That the observer measures, in their order; empty without one
    observer_period: float | None  #: s; None without an observer
    #: Names by kind (states, disturbances, inputs, controlled); empty in exports of former versions
    signals: Mapping[str, tuple[str, ...]]
    overrides: tuple[str, ...]  #: That it was exported with


def read_export(path: Path, where: str = "--exported") -> ExportFolder:
    """What a folder holds, by its ``controller.json``.

    Raises ConfigurationError for a folder that is not there or holds no export.
    """
    if not path.is_dir():
        kind = "is no folder" if path.exists() else "does not exist"
        raise ConfigurationError(f"{str(path)!r} {kind}", where=where, remedy=_REMEDY)
    try:
        document = read_json(path / DOCUMENT_NAME)
        if document["schema"] != _SCHEMA or not _NAME.fullmatch(document["name"]):
            raise ValueError(document["schema"])
        observer = document["observer"] or {}
        export = ExportFolder(
            path,
            document["name"],
            float(document["control_period_s"]),
            tuple(map(str, observer.get("channels", ()))),
            float(observer["sample_time_s"]) if observer else None,
            {
                str(kind): tuple(map(str, listed))
                for kind, listed in document.get("signals", {}).items()
            },
            _words_of(str(document["command"])),
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigurationError(
            f"{str(path)!r} holds no exported controller ({type(error).__name__}: {error})",
            where=where,
            remedy=_REMEDY,
        ) from None
    for suffix in (".c", ".h"):
        if not (path / f"{export.name}{suffix}").is_file():
            raise ConfigurationError(
                f"{export.name}{suffix} is missing in {str(path)!r}", where=where, remedy=_REMEDY
            )
    return export


def _words_of(command: str) -> tuple[str, ...]:
    """Overrides of the command that exported it."""
    import shlex

    return tuple(word for word in shlex.split(command)[2:] if "=" in word)


class Library(EngineLibrary):
    """The compiled source of an export.

    Raises ConfigurationError without a compiler, and for a source that does not compile.
    """

    def __init__(self, export: ExportFolder) -> None:
        super().__init__(_built(export), export.name)
        self.export = export
        sizes, bytes_of, period = (
            (ctypes.c_int * 2)(),
            (ctypes.c_size_t * 1)(),
            (ctypes.c_double * 1)(),
        )
        self.function("drive_observer")(sizes, bytes_of, period)
        self.n_y, self.n_z = sizes
        self.observer_bytes, self.observer_period = bytes_of[0], period[0]

    def check_model(self, model: Model) -> None:
        """Refuse a model that has other signals than the one that was exported.

        Raises ConfigurationError: the C takes and gives them by their position.
        """
        mine = {
            "states": model.state_names,
            "disturbances": names(model.disturbances),
            "inputs": names(model.inputs),
            "controlled": model.controlled,
        }
        sizes = {"states": self.n_x, "disturbances": self.n_w, "inputs": self.n_u}
        sizes["controlled"] = self.n_r
        for kind, own in mine.items():
            exported = self.export.signals.get(kind)
            if len(own) != sizes[kind] or (exported is not None and exported != tuple(own)):
                words = ", ".join(exported) if exported else f"{sizes[kind]} of them"
                raise ConfigurationError(
                    f"the {kind} of model {model.name!r} are {', '.join(own)}, those of the "
                    f"export: {words}",
                    where="model",
                    remedy="leave model= out: that of the export is taken",
                )


@functools.lru_cache(maxsize=8)
def _library(folder: Path) -> Library:
    return Library(read_export(folder, "folder"))


def _built(export: ExportFolder) -> Path:
    """The library in the cache; made anew where the source is another."""
    program = compiler()
    if program is None:
        raise ConfigurationError(
            "there is no C compiler to compile the export with",
            where="--exported",
            remedy="`trms doctor` tells what to install",
        )
    name = export.name
    text = {
        file: read_bytes(export.path / file, _LARGEST_SOURCE).decode("utf-8")
        for file in (f"{name}.c", f"{name}.h")
    }
    if f"static void {name}_start(" not in text[f"{name}.c"]:
        raise ConfigurationError(
            f"{name}.c was exported by a former version of trms",
            where="--exported",
            remedy="export it again: the command stands in its README.md",
        )
    calls = source.template("driver.c") + template("drive_observer.c")
    driver = with_prefix(f'{engine.CLOCK}#include "{name}.c"\n' + calls, name)

    def write(folder: Path) -> Path:
        for file, content in text.items():
            (folder / file).write_text(content, encoding="utf-8")
        source = folder / f"{name}_drive.c"
        source.write_text(driver, encoding="utf-8")
        return source

    library = build_library(
        f"exported_{name}",
        [*text.values(), driver],
        engine.FLAGS,
        write,
    )
    if library is None:
        raise ConfigurationError(
            f"{name}.c does not compile here, or the cache folder cannot be written",
            where="--exported",
            remedy=f"make -C {export.path} check, and `trms doctor`, say why",
        )
    return library


@dataclass(frozen=True, kw_only=True)
class _Exported:
    """What controller and observer have in common."""

    folder: str  #: Written by ``trms export-controller``

    def __post_init__(self) -> None:
        if not self.folder:
            raise ConfigurationError(
                "no folder of an export given",
                where="folder",
                remedy="`trms rig drive --exported FOLDER` gives it; in its place: observer=ukf",
            )
        check_export(Path(self.folder), "folder")

    @property
    def library(self) -> Library:
        """Compiled where it has not been yet."""
        return _library(Path(self.folder))


@dataclass(frozen=True, kw_only=True)
class ExportedController(_Exported):
    """The exported controller in the place of the one that it was exported from."""

    delay: Delay = "none"

    @property
    def sample_time(self) -> float:
        """Control period, s: that of the export."""
        return read_export(Path(self.folder), "folder").period

    def preview(self, setup: ControlSetup) -> int:
        """Control periods that the exported source sees ahead."""
        return self.library.preview

    def init(self, setup: ControlSetup) -> EngineContext:
        """A fresh context.

        Raises ConfigurationError for another model, or another period, than was exported.
        """
        library = self.library
        library.check_model(setup.model)
        _check_period(setup.sample_time, library.period, "controller")
        return EngineContext(library, setup.first_command)

    def step(
        self, state: EngineContext, sample: ControlSample, *, want_prediction: bool
    ) -> Command:
        """The command from now to the next control period.

        Raises SimulationError for a sample without a solution where the export ends the run then.
        """
        command = state.step(sample)
        if command.fallback == "stop":
            raise end_of_run("exported", command.message)
        return command


@dataclass(frozen=True)
class ObserverContext:
    """An observer's memory in C, and the arrays that it reads and writes."""

    memory: FloatArray  #: Holds the struct
    u: FloatArray  #: (n_u,) array; V
    y: FloatArray  #: (n_y,) array; NaN where missing
    known: FloatArray  #: (n_w,) array; measured torques, N m
    present: FloatArray  #: (n_y,) array; 1 for what was used of the last measurement
    estimate: Estimate  #: Views of what it writes
    call: Any  #: One sample, its arguments bound


@dataclass(frozen=True, kw_only=True)
class ExportedObserver(_Exported):
    """The exported filter in the place of the one that it was exported from."""

    def init(self, setup: ObserverSetup) -> ObserverContext:
        """A fresh filter, at rest with what is measured first.

        Raises ConfigurationError for another model, other channels or another sample time than was
        exported, and for an export without an observer.
        """
        library, model = self.library, setup.model
        export = library.export
        if not library.n_y:
            raise ConfigurationError(
                "the export has no observer",
                remedy="observer=ukf estimates in its place; or export the controller with one",
            )
        library.check_model(model)
        _check_period(setup.sample_time, library.observer_period, "sim")
        if tuple(setup.outputs) != export.channels:
            raise ConfigurationError(
                f"the rig measures {', '.join(setup.outputs)}; the exported observer takes "
                f"{', '.join(export.channels)}",
                where="plant",
                remedy="a wiring of these channels, or an export for the rig's: "
                f"plant.sensors.channels=[{','.join(setup.outputs)}]",
            )
        n_x, n_w, n_y, n_z = library.n_x, library.n_w, library.n_y, library.n_z
        memory = np.zeros(-(-library.observer_bytes // 8))
        u, y, known, x, w = map(np.zeros, (library.n_u, n_y, n_w, n_x, n_w))
        words = np.zeros(n_z + n_w + 5 * n_y)
        sd, w_sd, *of_channels = np.split(words, np.cumsum([n_z, n_w, *[n_y] * 4]))
        predicted, innovation, innovation_sd, rejected, present = of_channels
        first_y = np.full(n_y, np.nan)
        if np.shape(setup.first_measurement) == (n_y,):
            first_y[:] = setup.first_measurement
        first_u = np.ascontiguousarray(setup.first_command, dtype=float)
        library.function("observer_init")(*map(_pointer, (memory, first_y, first_u)))
        call = functools.partial(
            library.function("drive_observe"), *map(_pointer, (memory, u, y, known, x, w, words))
        )
        estimate = Estimate(x, sd[:n_x], w, w_sd, predicted, innovation, innovation_sd, rejected)
        return ObserverContext(memory, u, y, known, present, estimate, call)

    def step(
        self,
        state: ObserverContext,
        command: FloatArray,
        measurement: FloatArray,
        truth: Mapping[str, float] | None,
        known: FloatArray | None = None,
    ) -> Estimate:
        """The estimate at this sample."""
        state.u[:], state.y[:] = command, measurement
        if known is not None:
            state.known[:] = known
        state.call()
        estimate = state.estimate
        if not all(state.present.tolist()):
            estimate.innovation[state.present == 0.0] = np.nan
        return estimate


def _check_period(period: float, exported: float, group: str) -> None:
    if abs(period - exported) > 1e-9 * exported:
        raise ConfigurationError(
            f"{period:g} s, and the source was exported for {exported:g} s",
            where=f"{group}.sample_time",
            remedy=f"{group}.sample_time={exported:g}, or export it for {period:g} s",
        )


def _pointer(array: FloatArray) -> Any:
    return array.ctypes.data_as(_Pointer)
