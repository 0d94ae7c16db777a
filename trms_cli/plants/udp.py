"""A rig at the other end of a network cable, or in another process: frames in datagrams."""

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from trms_cli.plants.link.linked_rig import LinkedRig, LinkedRun
from trms_cli.plants.link.transport import Transport, UdpTransport
from trms_cli.plants.plant import PlantSetup


@dataclass(frozen=True, kw_only=True)
class UdpRig(LinkedRig):
    """A rig that answers datagrams."""

    host: str  #: Name or address of the rig's computer
    port: Annotated[int, Meta(ge=1, le=65535)]

    def init(self, setup: PlantSetup) -> "UdpRun":
        """The rig before it is connected.

        Raises ConfigurationError for a wiring that is wrong.
        """
        return UdpRun(self, setup)


class UdpRun(LinkedRun):
    """See :class:`trms_cli.plants.link.linked_rig.LinkedRun`."""

    rig: UdpRig

    def _open(self) -> Transport:
        return UdpTransport(self.rig.host, self.rig.port)

    def _address(self) -> tuple[str, str]:
        return f"{self.rig.host}:{self.rig.port}", "plant.port"
