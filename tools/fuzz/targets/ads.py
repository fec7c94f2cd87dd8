"""A device with ADS services given any requests, in AMS packets or cut from the octets."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import cycle
from struct import Struct

from eap.ads.device import AdsDevice
from eap.ads.notifications import AdsClient
from eap.ads.request import MAX_ANSWER
from eap.ads.symbols import SymbolSpace, SymbolTable, SymbolVariable
from eap.ams.access import LOOKUPS
from eap.codec import datatypes
from eap.codec.ads import AdsDeviceInfo, AdsState, AdsStates, IndexGroup, device_name
from eap.codec.adsnotification import decode_notification
from eap.codec.ams import AmsCommand, AmsHeader
from eap.codec.datatypes import Part, find_variable
from eap.ids import Endpoint, NetId
from tools.fuzz.messages import cut

_TYPES = {
    "flags": "WORD",
    "name": "STRING(20)",
    "curve": "REAL[4]",
    "depth": "INT24",
    "wide": "UINT24[2]",
    "axis": (
        "ST_Axis<24/4:x@0 REAL,bits@4.0 BIT3,on@4.7 BIT1,name@6 WSTRING(2),"
        "u@12 U_Any<4/4:all@0 UDINT,each@0 BYTE[2,1..2]>,last@16 ST_P<4/2:a@0 INT,b@2 BYTE>[2]>"
    ),
}
_STEPS = (
    b"axis", b"wide", b".u", b".each", b"[1,2]", b".last", b"[1]", b".b", b".X", b".bits", b".name",
    b"[99999999999]", b".", b"[", b"curve", b"[-1]", b"\0", b"\xff", b".on", b"a" * 300,
)  # fmt: skip
"""Parts of names, good and bad."""
_HEAD = Struct("<5I")
_LOOKUP = Struct("<4I")
_VERSION = 1
_CLIENT = AdsClient(Endpoint("door", "connection"), NetId(bytes(6)), 1)
_COMMANDS = tuple(AmsCommand)
_GROUPS = tuple(IndexGroup)


class _Store:
    """Keeps octets, and insists on their number."""

    def __init__(self) -> None:
        self.types = {name: datatypes.parse(kind) for name, kind in _TYPES.items()}
        self.octets = {name: bytes(kind.size) for name, kind in self.types.items()}

    def read(self, name: str) -> bytes:
        """Return what was stored; of a bit field a byte."""
        variable, part = self._find(name)
        offset, size = part.bit_offset // 8, part.kind.size
        return self.octets[variable][offset : offset + size]

    def write(self, name: str, octets: bytes) -> None:
        """Store as many octets as the type has, and no others."""
        variable, part = self._find(name)
        if len(octets) != part.kind.size:
            raise AssertionError(f"{len(octets)} octets for {name}")
        whole, offset = self.octets[variable], part.bit_offset // 8
        self.octets[variable] = whole[:offset] + octets + whole[offset + len(octets) :]

    def _find(self, name: str) -> tuple[str, Part]:
        found = find_variable(name, self.types.get)
        if found is None:
            raise AssertionError(f"no variable {name!r}")
        return found


def _device() -> AdsDevice:
    store = _Store()
    variables = [SymbolVariable(name, kind) for name, kind in store.types.items()]
    return AdsDevice(
        AdsDeviceInfo(1, 0, 0, device_name("fuzzed")),
        lambda: AdsStates(AdsState.RUN, 8),
        [SymbolSpace(SymbolTable(variables, _VERSION), store)],
    )


def _requests(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the packet as it is, then messages, half of them with a group that exists."""
    if len(data) >= AmsHeader.SIZE:
        yield AmsHeader.decode(data).command, data[AmsHeader.SIZE :]
    for message, is_helped in zip(cut(data), cycle((False, True)), strict=False):
        if is_helped and len(message) >= _HEAD.size:
            yield _helped(message)
        else:
            yield _COMMANDS[len(message) % len(_COMMANDS)], message


def _helped(message: bytes) -> tuple[int, bytes]:
    """Return a request with a group, names and places that exist or nearly do."""
    group, offset, *rest = _HEAD.unpack_from(message)
    group, behind = _GROUPS[group % len(_GROUPS)], message[_HEAD.size :]
    if group in LOOKUPS:
        name = b"".join(_STEPS[each % len(_STEPS)] for each in behind)
        return AmsCommand.READ_WRITE, _LOOKUP.pack(group, offset, 0xFFFF, len(name)) + name
    if group == IndexGroup.VALUE_BY_HANDLE:
        offset = _VERSION << 24 | offset % 64
    elif group in {IndexGroup.DATA, IndexGroup.DATA_BITS}:
        offset %= 512
    body = _HEAD.pack(group, offset, *rest) + behind
    return _COMMANDS[len(message) % len(_COMMANDS)], body


def fuzz_one(data: bytes) -> None:
    """Answer every request and send notifications without an exception."""
    device = _device()
    for now_ns, (command, body) in enumerate(_requests(data)):
        answer = device.answer(command, body, _CLIENT, now_ns)
        if len(answer.data) > MAX_ANSWER + 8 or not (answer.error_code or len(answer.data) >= 4):
            raise AssertionError(f"an answer of {len(answer.data)} octets")
        for _, notice in device.notifications.handle_cycle(now_ns, now_ns):
            decode_notification(notice)
