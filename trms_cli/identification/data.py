"""From files to datasets: what ``real=[FILE, …]`` and the keys of ``data`` mean.

The recordings are read, cut, and checked against the model as a replay does it; here they become
plain arrays.
"""

import glob
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from trms_cli.core.arrays import FloatArray
from trms_cli.core.errors import ConfigurationError, TrmsError
from trms_cli.identification.admission.sampling import require_sample_time
from trms_cli.identification.dataset import Dataset
from trms_cli.models.model import Model, Signal, names
from trms_cli.plants.sensors import Sensors
from trms_cli.recordings.for_model import Selection
from trms_cli.recordings.preparation import Preparation

#: The word of ``noise_sd`` that asks for an estimate.
ESTIMATE: Literal["estimate"] = "estimate"
#: The log in a folder of ``trms run``.
_LOG = "run.mcap"


@dataclass(frozen=True, kw_only=True)
class DataOptions:
    """What is taken from recordings."""

    start: float | None = None  #: Part of each recording to take, s in its own time
    end: float | None = None  #: None for all
    #: Name of a signal's column in the file, where it has another one: {position: q_meas}
    names: Mapping[str, str] = field(default_factory=dict)
    #: By input: what a recorded 1 is in the model's unit, where the units differ
    input_scale: Mapping[str, float] = field(default_factory=dict)
    #: By output: what is added to it, in its SI unit, where its zero is another one than the
    #: model's (pitch is 0 where the beam is level)
    offset: Mapping[str, float] = field(default_factory=dict)
    command_delay: Annotated[int, Meta(ge=0)] = 0  #: Samples until the command of a row acts
    #: Largest deviation of a step from whole sample times, as a share of one
    jitter: Annotated[float, Meta(gt=0, lt=0.5)] = 0.2
    channels: tuple[str, ...] | None = None  #: Outputs to use; None: all that both have
    #: dict of str to float, or "estimate"; white noise per output, in its unit. ``estimate`` takes
    #: it from the data (see :func:`noise_estimate`), as that of an output is which neither this nor
    #: ``quantum`` names while they name others.
    noise_sd: Mapping[str, Annotated[float, Meta(ge=0)]] | Literal["estimate"] = field(
        default_factory=dict
    )
    #: Resolution per output, in its unit; its share of the noise is q/√12
    quantum: Mapping[str, Annotated[float, Meta(ge=0)]] = field(default_factory=dict)
    resample: Annotated[float, Meta(gt=0)] | None = None  #: New sample time, s; None: as recorded
    #: "keep" or "mark"; whether outliers become missing samples; they are reported in any case
    outliers: Literal["keep", "mark"] = "keep"
    #: "keep", "split" or float; ``keep`` leaves missing samples missing; ``split`` makes a dataset
    #: of each part between gaps of ``t``; a number fills what is missing for so many s at most
    gaps: Literal["keep", "split"] | Annotated[float, Meta(gt=0)] = "keep"
    #: s by which a channel is recorded late; negative for one that is early
    delays: Mapping[str, float] = field(default_factory=dict)

    def sensors(self) -> Sensors:
        """The channels that are taken, and what is declared of their noise."""
        noise = {} if self.noise_sd == ESTIMATE else self.noise_sd
        assert isinstance(noise, Mapping)
        return Sensors(channels=self.channels, noise_sd=noise, quantum=self.quantum)

    def selection(self) -> Selection:
        """What of a recording a model takes."""
        return Selection(
            start=self.start,
            end=self.end,
            names=self.names,
            input_scale=self.input_scale,
            command_delay=self.command_delay,
            jitter=self.jitter,
            sensors=self.sensors(),
        )

    def preparation(self) -> Preparation:
        """How the part that is taken is made ready."""
        return Preparation(
            resample=self.resample,
            outliers=self.outliers,
            gaps=self.gaps,
            delays=self.delays,
            jitter=self.jitter,
        )


def load_datasets(
    real: Sequence[str] | str, model: Model, options: DataOptions | None = None
) -> list[Dataset]:
    """Read recordings for a model, in the order of the files, with unique names.

    A file that is split at its gaps gives more than one. ``real``: files (CSV, MAT, MCAP), folders
    of runs, or patterns such as ``monday/*.csv``. ``model``: its inputs must all be recorded; of
    its outputs those are taken that are. ``options``: None takes the defaults: everything, with no
    noise declared. Raises RecordingError if a file cannot be read or is not evenly sampled,
    ConfigurationError if its channels or units are not those of the model; it tells what to do.
    """
    options = options or DataOptions()
    datasets: list[Dataset] = []
    for file in files_of(real):
        with _in_words_of_data():
            runs = options.selection().read(file, model, options.preparation())
            sha256 = runs[0].sha256
        for run in runs:
            remarks = [*run.remarks]
            measurements = _offset(run.measurements, run.outputs, options.offset, remarks)
            measured = names(run.outputs)
            noise_sd = options.sensors().noise_in(
                run.measurements,
                run.outputs,
                remarks,
                measured if options.noise_sd == ESTIMATE else (),
            )
            dataset = Dataset(
                _unique(file, [d.name for d in datasets]),
                file,
                sha256,
                run.sample_time,
                run.time,
                run.inputs,
                run.outputs,
                np.ascontiguousarray(run.commands),
                np.ascontiguousarray(measurements),
                np.array([noise_sd[name] for name in measured]),
                tuple(remarks),
            )
            # Before anything simulates it: between samples of 20 s nothing stays finite.
            require_sample_time(dataset, model)
            datasets.append(dataset)
    return datasets


def _offset(
    measurements: FloatArray,
    outputs: Sequence[Signal],
    offset: Mapping[str, float],
    remarks: list[str],
) -> FloatArray:
    """Measurements with what is to be added to them; told in the remarks."""
    result = measurements.copy()
    for name, value in offset.items():
        if name not in names(outputs):
            raise ConfigurationError(
                f"no output {name!r} is taken from the recording",
                where=f"data.offset.{name}",
                remedy=f"its outputs are {', '.join(names(outputs))}",
            )
        if not np.isfinite(value):
            raise ConfigurationError(
                f"{value!r} given", where=f"data.offset.{name}", remedy="a finite number"
            )
        index = names(outputs).index(name)
        result[:, index] += value
        remarks.append(f"{value:+.4g} {outputs[index].unit} added to {name}")
    return result


def files_of(real: Sequence[str] | str) -> list[str]:
    """The files that ``real`` names, patterns and folders of runs resolved.

    Raises ConfigurationError if nothing is named, a pattern fits no file, a folder holds no log, or
    a file occurs twice.
    """
    entries = [real] if isinstance(real, str) else list(real)
    files: list[str] = []
    for name in entries:
        path = Path(name).expanduser()
        if path.is_dir():
            if not (path / _LOG).is_file():
                raise ConfigurationError(
                    f"the folder {name!r} holds no {_LOG}",
                    where="real",
                    remedy=f"give the folder of a run, a file, or a pattern: '{name}/*.csv'",
                )
            files.append(str(path / _LOG))
        elif path.exists() or not any(sign in name for sign in "*?["):
            files.append(str(path))
        else:
            fitting = sorted(glob.glob(str(path), recursive=True))
            if not fitting:
                raise ConfigurationError(
                    f"no file fits the pattern {name!r}", where="real", remedy="look at the folder"
                )
            files += fitting
    if not files:
        raise ConfigurationError(
            "no recording is given", where="real", remedy="real=FILE, or 'real=[FILE, FILE]'"
        )
    twice = next((file for i, file in enumerate(files) if file in files[:i]), None)
    if twice is not None:
        raise ConfigurationError(
            f"{twice} is given twice", where="real", remedy="a recording counts once"
        )
    return files


def _unique(file: str, used_names: Sequence[str]) -> str:
    """A short name for a file (of a run, its folder's), numbered from 2 on if it is taken."""
    path = Path(file)
    name = path.absolute().parent.name if path.name == _LOG else path.stem
    number, candidate = 1, name
    while candidate in used_names:
        number += 1
        candidate = f"{name}-{number}"
    return candidate


@contextmanager
def _in_words_of_data() -> Iterator[None]:
    """Errors of a replayed plant, told by the keys that are given here."""
    try:
        yield
    except TrmsError as error:
        for part in ("where", "remedy"):
            text = str(getattr(error, part))
            if part == "remedy" or text.startswith(("plant.", "sensors.")):  # it may be a path
                text = text.replace("plant.file", "real")
                text = text.replace("plant.", "data.").replace("sensors.", "data.")
            if part == "where" and text.split(".")[0] in ("resample", "gaps", "delays"):
                text = f"data.{text}"
            setattr(error, part, text)
        raise
