"""The mailbox of a simulated device: the servers that its description asks for."""

from __future__ import annotations

from devicebus.mailbox.coe_server import CoeServer
from devicebus.mailbox.foe_server import FoeServer
from devicebus.mailbox.foe_store import AllowedIn, MemoryFile, MemoryStore
from devicebus.mailbox.protocol import MailboxSizes, ProtocolServer
from devicebus.mailbox.server import MailboxServer
from devicebus.sim.device import Device
from devicebus.sim.spec import FileSpec, MailboxSpec
from devicebus.wire.alstatus import AlState
from eap.codec.mailbox import MailboxType


def build_mailbox(spec: MailboxSpec, files: tuple[FileSpec, ...], device: Device) -> MailboxServer:
    """Make the servers of *device*."""
    sizes = MailboxSizes(spec.size, spec.size)
    servers: dict[MailboxType, ProtocolServer] = {}
    if spec.coe:
        servers[MailboxType.COE] = CoeServer(device.dictionary, device.od_state, sizes)
    if spec.foe:
        store = MemoryStore(map(_file, files), is_boot=lambda: device.al_state is AlState.BOOT)
        servers[MailboxType.FOE] = FoeServer(store, sizes)
    return MailboxServer(servers, sizes)


def _file(spec: FileSpec) -> MemoryFile:
    return MemoryFile(
        spec.name,
        spec.content.encode(),
        password=spec.password,
        allowed_in=AllowedIn.BOOT if spec.boot_only else AllowedIn.ANY_STATE,
        max_size=spec.max_size,
    )
