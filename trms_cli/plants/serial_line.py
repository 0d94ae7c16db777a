"""A rig on a serial line: a microcontroller on USB, a pseudo-terminal."""

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from trms_cli.plants.link.linked_rig import LinkedRig, LinkedRun
from trms_cli.plants.link.transport import Transport, open_serial
from trms_cli.plants.plant import PlantSetup


@dataclass(frozen=True, kw_only=True)
class SerialRig(LinkedRig):
    """A rig that answers frames on a serial line."""

    port: str  #: /dev/ttyACM0, COM3
    baudrate: Annotated[int, Meta(ge=9600)] = 921600  #: bit/s; USB takes any

    def init(self, setup: PlantSetup) -> "SerialRun":
        """The rig before it is connected.

        Raises ConfigurationError for a wiring that is wrong.
        """
        return SerialRun(self, setup)


class SerialRun(LinkedRun):
    """See :class:`trms_cli.plants.link.linked_rig.LinkedRun`."""

    rig: SerialRig

    def _open(self) -> Transport:
        return open_serial(self.rig.port, self.rig.baudrate)

    def _address(self) -> tuple[str, str]:
        return self.rig.port, "plant.port"
