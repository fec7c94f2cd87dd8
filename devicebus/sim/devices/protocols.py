"""The mailbox of a simulated device: the servers that its description asks for."""

from __future__ import annotations

from collections.abc import Iterable

from devicebus.mailbox.coe_server import CoeServer
from devicebus.mailbox.eoe_server import EoeServer
from devicebus.mailbox.foe_server import FoeServer
from devicebus.mailbox.foe_store import AllowedIn, MemoryFile, MemoryStore
from devicebus.mailbox.protocol import MailboxSizes, ProtocolServer
from devicebus.mailbox.server import MailboxServer
from devicebus.mailbox.soe_parameter import SoeParameter
from devicebus.mailbox.soe_server import SoeServer
from devicebus.mailbox.voe_server import VoeServer
from devicebus.sim.device import Device
from devicebus.sim.spec import FileSpec, MailboxSpec
from devicebus.wire.alstatus import AlState
from eap.codec.mailbox import MailboxType


def build_mailbox(
    spec: MailboxSpec,
    files: Iterable[FileSpec],
    device: Device,
    parameters: Iterable[SoeParameter] = (),
) -> MailboxServer:
    """Make the servers of *device*; SoE has *parameters*, VoE echoes."""
    sizes = MailboxSizes(spec.size, spec.size)
    servers: dict[MailboxType, ProtocolServer] = {}
    if spec.coe:
        servers[MailboxType.COE] = CoeServer(device.dictionary, device.od_state, sizes)
    if spec.foe:
        store = MemoryStore(map(_file, files), is_boot=lambda: device.al_state is AlState.BOOT)
        servers[MailboxType.FOE] = FoeServer(store, sizes)
    if spec.soe:
        servers[MailboxType.SOE] = SoeServer({0: parameters}, device.od_state, sizes)
    if spec.eoe:
        servers[MailboxType.EOE] = EoeServer(sizes)
    if spec.voe:
        servers[MailboxType.VOE] = VoeServer()
    return MailboxServer(servers, sizes)


def _file(spec: FileSpec) -> MemoryFile:
    return MemoryFile(
        spec.name,
        spec.content.encode(),
        password=spec.password,
        allowed_in=AllowedIn.BOOT if spec.boot_only else AllowedIn.ANY_STATE,
        max_size=spec.max_size,
    )
