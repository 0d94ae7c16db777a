"""A recording in the place of a rig: for observers, since no command can change what was measured.

What it holds for a model is read as everywhere: see :mod:`trms_cli.recordings.for_model`.
"""

from dataclasses import dataclass, field, replace
from typing import Annotated, NoReturn

from msgspec import Meta

from trms_cli.core.errors import ConfigurationError
from trms_cli.models.model import Model
from trms_cli.plants.plant import PlantSetup
from trms_cli.plants.sensors import Sensors
from trms_cli.recordings.for_model import RecordedRun, Selection


@dataclass(frozen=True, kw_only=True)
class RecordedRig(Selection):
    """A recorded run of a rig: a file, and what a model takes of it."""

    file: str  #: CSV, MAT or MCAP; a relative path is relative to the working directory
    command_delay: Annotated[int, Meta(ge=0)] = 0  #: samples, as of :class:`Selection`
    jitter: Annotated[float, Meta(gt=0, lt=0.5)] = 0.2  #: share of a sample, likewise
    #: Channels to use and their declared noise; noise and quantum are those of the record
    sensors: Sensors = field(default_factory=Sensors)

    def __post_init__(self) -> None:
        if self.sensors.loss_probability > 0:
            raise ConfigurationError(
                f"{self.sensors.loss_probability!r} given",
                where="sensors.loss_probability",
                remedy="a recording has lost what it has lost; leave this out",
            )
        super().__post_init__()

    def init(self, setup: PlantSetup) -> NoReturn:
        """Refuse to be controlled.

        Raises ConfigurationError: Always: see :meth:`load`.
        """
        raise ConfigurationError(
            "a recording cannot be controlled",
            where="plant",
            remedy="close the loop with plant=simulated",
        )

    def load(self, model: Model) -> RecordedRun:
        """Read the recording and check it against the model.

        Raises RecordingError if it cannot be read or is not evenly sampled. Raises
        ConfigurationError if its channels or units are not those of the model; it tells what to do.
        """
        run = self.read(self.file, model)[0]
        remarks = [*run.remarks]
        noise_sd = self.sensors.noise_in(run.measurements, run.outputs, remarks)
        return replace(run, noise_sd=noise_sd, remarks=tuple(remarks))
