"""Mailbox of a simulated device: servers of the described protocols."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import partial
from zlib import crc32

from devicebus.mailbox.aoe_server import AdsServer, AoeServer
from devicebus.mailbox.coe_server import CoeServer
from devicebus.mailbox.eoe import EoeServer
from devicebus.mailbox.foe_server import AllowedIn, FoeServer, MemoryFile, MemoryStore, store_error
from devicebus.mailbox.protocol import MailboxSizes, ProtocolServer
from devicebus.mailbox.server import MailboxServer
from devicebus.mailbox.soe_server import SoeParameter, SoeServer
from devicebus.mailbox.voe import VoeServer
from devicebus.sim.device import Device
from devicebus.sim.devices.ethernet_host import EthernetHost
from devicebus.sim.devices.objects import RX_PDO, TX_PDO
from devicebus.sim.spec import AccessKind, FileSpec, MailboxSpec
from devicebus.wire.alstatus import AlState
from eap.codec.coe import CoeService
from eap.codec.foe import FoeErrorCode
from eap.codec.mailbox import MailboxType

_WRITABLE = frozenset((AccessKind.WRITE, AccessKind.READ_WRITE))
_CRC_SIZE = 4


def build_mailbox(
    spec: MailboxSpec,
    files: Iterable[FileSpec],
    device: Device,
    sizes: MailboxSizes,
    drives: Mapping[int, Iterable[SoeParameter]] | None = None,
) -> MailboxServer:
    """Build the servers of *device*; SoE has the IDNs of *drives*, VoE echoes."""
    servers: dict[MailboxType, ProtocolServer] = {}
    if spec.coe:
        servers[MailboxType.COE] = _coe(device, sizes)
    if spec.foe:
        store = MemoryStore(map(_file, files), is_boot=lambda: device.al_state is AlState.BOOT)
        servers[MailboxType.FOE] = FoeServer(store, sizes)
    if spec.soe:
        servers[MailboxType.SOE] = SoeServer(drives or {0: ()}, device.od_state, sizes)
    if spec.eoe:
        servers[MailboxType.EOE] = _eoe(device.name, sizes)
    if spec.voe:
        servers[MailboxType.VOE] = VoeServer()
    if spec.aoe:
        ads = AdsServer(device.dictionary, device.od_state, device.name)
        servers[MailboxType.AOE] = AoeServer(ads, sizes, reset_handler=ads.reset_address)
    return MailboxServer(servers, sizes)


def _coe(device: Device, sizes: MailboxSizes) -> CoeServer:
    """Return the CoE server; PDO numbers in the mailbox count from 0x1600 or 0x1A00."""
    process_data = device.process_data

    def read_pdo(service: CoeService, number: int) -> bytes | None:
        base = TX_PDO if service is CoeService.TX_PDO else RX_PDO
        return process_data.read_pdo(base + number)

    def write_pdo(number: int, data: bytes) -> bool:
        return process_data.write_pdo(RX_PDO + number, data)

    return CoeServer(
        device.dictionary, device.od_state, sizes, read_pdo=read_pdo, write_pdo=write_pdo
    )


def _eoe(name: str, sizes: MailboxSizes) -> EoeServer:
    server: EoeServer
    host = EthernetHost(name, lambda: server.settings)
    server = EoeServer(sizes, receive_frame=host.receive_frame, announce=host.announce)
    return server


def _file(spec: FileSpec) -> MemoryFile:
    if spec.boot_only and spec.not_in_boot:
        raise ValueError(f"file {spec.name} exists in no state: boot_only and not_in_boot")
    allowed = AllowedIn.OTHERS if spec.not_in_boot else AllowedIn.ANY_STATE
    return MemoryFile(
        spec.name,
        spec.content.encode(),
        password=spec.password,
        readable=spec.access is not AccessKind.WRITE,
        writable=spec.access in _WRITABLE,
        allowed_in=AllowedIn.BOOT if spec.boot_only else allowed,
        max_size=spec.max_size,
        check=partial(_check_sum, spec.name) if spec.checksum else None,
    )


def _check_sum(name: str, content: bytes) -> None:
    if crc32(content[:-_CRC_SIZE]).to_bytes(_CRC_SIZE, "little") != content[-_CRC_SIZE:]:
        raise store_error(FoeErrorCode.CHECKSUM, name)
