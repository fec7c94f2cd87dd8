"""Emergencies of slaves by CoE and SoE: decoded, and kept for each slave in a bounded history.

An emergency says that an error has come; one with code 0 takes the errors of its sender back.  SoE
has no layout of its own: drives send the bytes of CoE.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from typing import NamedTuple

import msgspec

from devicebus.master.mailboxes import Unsolicited
from eap.codec.coe import CoeHeader, CoeService, Emergency
from eap.codec.mailbox import MailboxType
from eap.codec.soe import SoeHeader, SoeOpcode
from eap.errors import CodecError

HISTORY = 16
"""Emergencies kept for a slave; the oldest are dropped."""

# Error code classes of CiA 301; ETG.1000.6 adds 0xA0.
_CLASSES = {
    0x00: "no error", 0x10: "generic error", 0x20: "current", 0x21: "current, input side",
    0x22: "current inside the device", 0x23: "current, output side", 0x30: "voltage",
    0x31: "mains voltage", 0x32: "voltage inside the device", 0x33: "output voltage",
    0x40: "temperature", 0x41: "ambient temperature", 0x42: "device temperature",
    0x50: "hardware", 0x60: "software", 0x61: "internal software", 0x62: "user software",
    0x63: "data set", 0x70: "additional modules", 0x80: "monitoring", 0x81: "communication",
    0x82: "protocol error", 0x90: "external error", 0xA0: "state transition",
    0xF0: "additional functions", 0xFF: "device specific",
}  # fmt: skip


class SlaveEmergency(msgspec.Struct, frozen=True, kw_only=True):
    """Emergency of a slave; *at_ns* is the time of its master."""

    at_ns: int
    protocol: str
    """``CoE`` or ``SoE``."""
    drive: int
    """Number of the drive, by SoE only."""
    code: int
    register: int
    """Error register, object 0x1001."""
    data: bytes


def describe_code(code: int) -> str:
    """Return the class of an error code in words, that of its high digit if it has none."""
    high = code >> 8
    return _CLASSES.get(high) or _CLASSES.get(high & 0xF0, "unknown class")


def decode_emergency(message: Unsolicited, now_ns: int) -> SlaveEmergency | None:
    """Return the emergency in a message of a slave; None for another or a malformed message."""
    data = message.data
    drive = 0
    with suppress(CodecError):
        if message.type is MailboxType.COE:
            if CoeHeader.decode(data).service is not CoeService.EMERGENCY:
                return None
            body = Emergency.decode(data, CoeHeader.SIZE)
        elif message.type is MailboxType.SOE:
            header = SoeHeader.decode(data)
            if header.opcode is not SoeOpcode.EMERGENCY:
                return None
            drive = header.drive
            body = Emergency.decode(data, SoeHeader.SIZE)
        else:
            return None
        return SlaveEmergency(
            at_ns=now_ns,
            protocol="CoE" if message.type is MailboxType.COE else "SoE",
            drive=drive,
            code=body.error_code,
            register=body.error_register,
            data=bytes(body.data),
        )
    return None


class SlaveHistory(NamedTuple):
    """Emergencies of one slave: their number, and the latest, oldest first."""

    number: int = 0
    latest: tuple[SlaveEmergency, ...] = ()


class EmergencyLog:
    """Emergencies of all slaves of a bus by station address."""

    def __init__(self) -> None:
        self._counts: dict[int, int] = {}
        self._latest: dict[int, deque[SlaveEmergency]] = {}

    def take(self, message: Unsolicited, now_ns: int) -> None:
        """Note a message of a slave, if it is an emergency."""
        emergency = decode_emergency(message, now_ns)
        if emergency is None:
            return
        station = message.station
        self._counts[station] = self._counts.get(station, 0) + 1
        self._latest.setdefault(station, deque(maxlen=HISTORY)).append(emergency)

    def of(self, station: int) -> SlaveHistory:
        """Return the emergencies of a slave."""
        if station not in self._counts:
            return SlaveHistory()
        return SlaveHistory(self._counts[station], tuple(self._latest[station]))

    def forget_others(self, kept: Collection[int]) -> None:
        """Forget all slaves but those with station addresses in *kept*."""
        for station in self._counts.keys() - set(kept):
            del self._counts[station], self._latest[station]

    def clear(self) -> None:
        """Forget all, but not errors that are still there."""
        for station, latest in list(self._latest.items()):
            present = list(iter_present(latest))
            self._counts[station] = len(present)
            latest.clear()
            latest.extend(present)
            if not present:
                del self._counts[station], self._latest[station]


def iter_present(
    latest: Sequence[SlaveEmergency] | deque[SlaveEmergency],
) -> Iterator[SlaveEmergency]:
    """Yield the last emergency of each protocol and drive, unless it takes errors back."""
    last = {(each.protocol, each.drive): each for each in latest}
    yield from (each for each in last.values() if each.code)
