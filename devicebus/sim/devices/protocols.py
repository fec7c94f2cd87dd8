"""Mailbox of a simulated device: servers of the described protocols, and a host behind EoE."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import NamedTuple
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
from devicebus.sim.devices.objects import RX_PDO, TX_PDO
from devicebus.sim.spec import AccessKind, FileSpec, MailboxSpec
from devicebus.wire.alstatus import AlState
from eap.codec.coe import CoeService
from eap.codec.eoe import IpSettings
from eap.codec.foe import FoeErrorCode
from eap.codec.mailbox import MailboxType

DEFAULT_MAC = bytes.fromhex("020e5a000001")
_BROADCAST = b"\xff" * 6
_IP, _ARP = 0x0800, 0x0806
_ETHERNET = 14
_ARP_REQUEST = bytes.fromhex("0001 0800 06 04 0001")
_ARP_REPLY = bytes.fromhex("0001 0800 06 04 0002")
_ARP_SIZE = 28
_ICMP = 1
_ECHO_REQUEST, _ECHO_REPLY = 8, 0
_IP_HEADER = 20
_FRAGMENT = 0x3FFF


class _Addresses(NamedTuple):
    mac: bytes
    ip: bytes


class EthernetHost:
    """Host behind EoE that answers ARP and ping.

    Args:
        settings: Returns its IP settings; without an address it does not answer.
    """

    def __init__(self, settings: Callable[[], IpSettings]) -> None:
        self._settings = settings

    def receive_frame(self, frame: bytes) -> list[bytes]:
        """Return the answers to an Ethernet frame (without check sequence)."""
        settings = self._settings()
        if settings.ip is None or len(frame) < _ETHERNET:
            return []
        own = _Addresses(bytes(settings.mac or DEFAULT_MAC), settings.ip.packed)
        if frame[:6] not in {own.mac, _BROADCAST}:
            return []
        (kind,) = struct.unpack_from(">H", frame, 12)
        answer = None
        if kind == _ARP:
            answer = _answer_arp(frame, own)
        elif kind == _IP:
            answer = _answer_ping(frame, own)
        return [] if answer is None else [answer]


def _answer_arp(frame: bytes, own: _Addresses) -> bytes | None:
    body = frame[_ETHERNET : _ETHERNET + _ARP_SIZE]
    if len(body) < _ARP_SIZE or body[:8] != _ARP_REQUEST or body[24:28] != own.ip:
        return None
    asker = body[8:18]
    reply = _ARP_REPLY + own.mac + own.ip + asker
    return asker[:6] + own.mac + _ARP.to_bytes(2, "big") + reply


def _answer_ping(frame: bytes, own: _Addresses) -> bytes | None:
    packet = frame[_ETHERNET:]
    if len(packet) < _IP_HEADER or packet[0] >> 4 != 4:
        return None
    header_size = 4 * (packet[0] & 0x0F)
    total, fragment = struct.unpack_from(">2xH2xH", packet)
    message = packet[header_size:total]
    is_whole = header_size >= _IP_HEADER and len(message) == total - header_size >= 8
    if not is_whole or fragment & _FRAGMENT or packet[9] != _ICMP or packet[16:20] != own.ip:
        return None
    if message[0] != _ECHO_REQUEST:
        return None
    header = packet[:12] + packet[16:20] + packet[12:16] + packet[20:header_size]
    reply = bytearray(message)
    reply[0] = _ECHO_REPLY
    reply[2:4] = bytes(2)
    reply[2:4] = _checksum(reply).to_bytes(2, "big")
    return frame[6:12] + own.mac + frame[12:14] + header + reply


def _checksum(octets: bytes | bytearray) -> int:
    """Return the Internet check sum (RFC 1071)."""
    padded = bytes(octets) + bytes(len(octets) % 2)
    total: int = sum(struct.unpack(f">{len(padded) // 2}H", padded))
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    return ~total & 0xFFFF


_WRITABLE = frozenset((AccessKind.WRITE, AccessKind.READ_WRITE))
_CRC_SIZE = 4


def build_mailbox(
    spec: MailboxSpec,
    files: Iterable[FileSpec],
    device: Device,
    drives: Mapping[int, Iterable[SoeParameter]] | None = None,
) -> MailboxServer:
    """Build the servers of *device*; SoE has the IDNs of *drives*, VoE echoes."""
    sizes = MailboxSizes(spec.size, spec.size)
    servers: dict[MailboxType, ProtocolServer] = {}
    if spec.coe:
        servers[MailboxType.COE] = _coe(device, sizes)
    if spec.foe:
        store = MemoryStore(map(_file, files), is_boot=lambda: device.al_state is AlState.BOOT)
        servers[MailboxType.FOE] = FoeServer(store, sizes)
    if spec.soe:
        servers[MailboxType.SOE] = SoeServer(drives or {0: ()}, device.od_state, sizes)
    if spec.eoe:
        servers[MailboxType.EOE] = _eoe(sizes)
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


def _eoe(sizes: MailboxSizes) -> EoeServer:
    server: EoeServer
    host = EthernetHost(lambda: server.settings)
    server = EoeServer(sizes, receive_frame=host.receive_frame)
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
