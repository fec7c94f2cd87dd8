"""What can be asked of the slaves of one bus: by whom of their mailbox it is done."""

from __future__ import annotations

from devicebus.wire.sii import SiiProtocol
from eap.aoe.ads_operation import (
    AdsRefusedError,
    Operation,
    OperationOutcome,
    Read,
    ReadDeviceInfo,
    ReadState,
    ReadWrite,
    Write,
    WriteControl,
)
from eap.aoe.ads_state import DeviceDataSpace, al_state_for, states_of
from eap.appliance.bus_failure import no_mailbox
from eap.appliance.bus_request import SlaveDescription
from eap.appliance.handover import PortName
from eap.appliance.services.bus.bus_client import BusClient
from eap.appliance.services.bus_ads.files import SlaveFiles
from eap.appliance.services.bus_ads.idns import SlaveIdns
from eap.appliance.services.bus_ads.master_side import MasterSide
from eap.appliance.services.bus_ads.objects import SlaveObjects
from eap.appliance.services.bus_ads.passthrough import Passthrough
from eap.appliance.services.bus_ads.results import refusal
from eap.appliance.services.bus_ads.slave_space import Asked, SlaveSpace
from eap.appliance.services.bus_ads.vendor import SlaveVendor
from eap.codec.ads import AdsDeviceInfo, AdsError, IndexGroup, device_name
from eap.ids import NetId

_OCTET = 0xFF


class Slaves:
    """All slaves of a bus port.

    Args:
        bus: Talks to them.
        port: Where they are.
        net_id: Of the bus port.
        master: Brings them to states.
    """

    def __init__(self, bus: BusClient, port: PortName, net_id: NetId, master: MasterSide) -> None:
        self._master = master
        self._files = SlaveFiles(bus, port)
        self._idns = SlaveIdns(bus, port)
        self._spaces: list[SlaveSpace] = [
            SlaveObjects(bus, port),
            self._files,
            self._idns,
            SlaveVendor(bus, port),
        ]
        self._passthrough = Passthrough(bus, port, net_id)

    async def perform(self, asked: Asked, operation: Operation) -> OperationOutcome:
        """Do one operation; raises as the methods of a SlaveSpace do."""
        slave = asked.slave
        match operation:
            case ReadState():
                data = states_of(slave.state).encode()
            case ReadDeviceInfo():
                data = _device_info(slave).encode()
            case WriteControl(ads_state):
                data = b""
                self._master.request_slave_state(slave.station, al_state_for(ads_state))
            case Read(IndexGroup.DEVICE_DATA, offset, length):
                states = DeviceDataSpace(lambda: states_of(slave.state))
                data = states.read(IndexGroup.DEVICE_DATA, offset, length)
            case Read(group) | Write(group) | ReadWrite(group):
                space = self._space(slave, group)
                if space is None:
                    return await self._passthrough.perform(asked, operation)
                data = await _do(space, asked, operation)
            case _:
                why = "slaves give no notifications here: read what they have, again and again"
                raise AdsRefusedError(AdsError.SERVICE, why)
        return OperationOutcome(data=data)

    def _space(self, slave: SlaveDescription, group: int) -> SlaveSpace | None:
        """Return who serves a group; None means the slave itself."""
        space = next((each for each in self._spaces if group in each.groups), None)
        protocol = SiiProtocol.AOE if space is None else space.protocol
        if not slave.protocols & (protocol | SiiProtocol.AOE):
            if space is None:
                raise AdsRefusedError(AdsError.INDEX_GROUP)
            name = str(protocol.name).replace("OE", "oE")
            why = f"slave {slave.station} does not speak {name}"
            raise AdsRefusedError(AdsError.SERVICE, why)
        if not slave.state:
            raise AdsRefusedError(AdsError.TIMEOUT, f"slave {slave.station} does not answer")
        if not slave.to_slave:
            raise refusal(no_mailbox(slave))
        return space if slave.protocols & protocol else None


async def _do(space: SlaveSpace, asked: Asked, operation: Read | Write | ReadWrite) -> bytes:
    match operation:
        case Write(group, offset, data):
            await space.write(asked, group, offset, data)
            return b""
        case Read(group, offset, length):
            found = await space.read(asked, group, offset, length)
        case ReadWrite(group, offset, length, data):
            found = await space.read_write(asked, group, offset, length, data)
    if len(found) > operation.length:
        raise AdsRefusedError(
            AdsError.SIZE, f"{len(found)} octets, the client has room for {operation.length}"
        )
    return found


def _device_info(slave: SlaveDescription) -> AdsDeviceInfo:
    """Name the slave as its bus does; the version is its revision, from the highest octet down."""
    revision = slave.revision
    high, middle = revision >> 24 & _OCTET, revision >> 16 & _OCTET
    return AdsDeviceInfo(high, middle, revision & 0xFFFF, device_name(slave.name))
