"""The dictionary of a master, for all ways by which it is asked for: the gateway, and ADS."""

from __future__ import annotations

import os

from eap.appliance.handover import PortName
from eap.appliance.services.bus.bus_client import BusClient
from eap.appliance.services.master.master_values import MasterView
from eap.device.eap_objects import Identity
from eap.device.master_dictionary import MasterDictionary
from eap.od.profiles.master1100 import CONFIGURED

_OF_REGISTERS = range(0x8000, 0xB000)
"""Objects that show registers of slaves."""
_OF_CONFIGURED = range(CONFIGURED.first, CONFIGURED.last + 1)
"""Objects that repeat what slaves say of themselves."""


class MasterDesk:
    """The dictionary of the master behind one bus port, and the view that it shows.

    Args:
        client: Asks the engine.
        port: Which bus.
        release: Of this software.
        full: As the dictionary has it.
        padded: Likewise.

    Attributes:
        dictionary: To be served after :meth:`refresh`.
    """

    def __init__(
        self,
        client: BusClient,
        port: PortName,
        release: str,
        *,
        full: bool = False,
        padded: bool = False,
    ) -> None:
        self._view = MasterView(client, port)
        identity = Identity(
            device_name=f"EtherCAT master {port.station}/{port.port}",
            hardware_version=os.uname().machine,
            software_version=release,
        )
        self.dictionary = MasterDictionary(self._view, identity, full=full, padded=padded)

    async def refresh(self, index: int) -> None:
        """See to it that what the object at *index* shows is not old."""
        await self._view.refresh(with_registers=index in _OF_REGISTERS, place=_place(index))

    def is_fresh(self, index: int) -> bool:
        """Say whether what the object at *index* shows may be read at once."""
        return self._view.is_fresh(with_registers=index in _OF_REGISTERS, place=_place(index))


def _place(index: int) -> int | None:
    return index - CONFIGURED.first if index in _OF_CONFIGURED else None
