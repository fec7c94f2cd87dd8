"""A device with ADS services given any requests, in AMS packets or cut from the octets."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import cycle
from struct import Struct

from eap.ads.device import AdsDevice
from eap.ads.notifications import AdsClient
from eap.ads.request import MAX_ANSWER
from eap.ads.symbols import SymbolSpace, SymbolTable, SymbolVariable
from eap.codec import datatypes
from eap.codec.ads import AdsDeviceInfo, AdsState, AdsStates, IndexGroup, device_name
from eap.codec.adsnotification import decode_notification
from eap.codec.ams import AmsCommand, AmsHeader
from eap.ids import Endpoint, NetId
from tools.fuzz.messages import cut

_TYPES = {"flags": "WORD", "name": "STRING(20)", "curve": "REAL[4]", "depth": "INT24"}
_HEAD = Struct("<5I")
_CLIENT = AdsClient(Endpoint("door", "connection"), NetId(bytes(6)), 1)
_COMMANDS = tuple(AmsCommand)
_GROUPS = tuple(IndexGroup)


class _Store:
    """Keeps octets, and insists on their number."""

    def __init__(self) -> None:
        self.types = {name: datatypes.parse(kind) for name, kind in _TYPES.items()}
        self.octets = {name: bytes(kind.size) for name, kind in self.types.items()}

    def read(self, name: str) -> bytes:
        """Return what was stored."""
        return self.octets[name]

    def write(self, name: str, octets: bytes) -> None:
        """Store as many octets as the type has, and no others."""
        if len(octets) != self.types[name].size:
            raise AssertionError(f"{len(octets)} octets for {name}")
        self.octets[name] = octets


def _device() -> AdsDevice:
    store = _Store()
    variables = [SymbolVariable(name, kind) for name, kind in store.types.items()]
    return AdsDevice(
        AdsDeviceInfo(1, 0, 0, device_name("fuzzed")),
        lambda: AdsStates(AdsState.RUN, 8),
        [SymbolSpace(SymbolTable(variables, 1), store)],
    )


def _requests(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the packet as it is, then messages, half of them with a group that exists."""
    if len(data) >= AmsHeader.SIZE:
        yield AmsHeader.decode(data).command, data[AmsHeader.SIZE :]
    for message, is_helped in zip(cut(data), cycle((False, True)), strict=False):
        command, body = _COMMANDS[len(message) % len(_COMMANDS)], message
        if is_helped and len(message) >= _HEAD.size:
            group, *rest = _HEAD.unpack_from(message)
            body = _HEAD.pack(_GROUPS[group % len(_GROUPS)], *rest) + message[_HEAD.size :]
        yield command, body


def fuzz_one(data: bytes) -> None:
    """Answer every request and send notifications without an exception."""
    device = _device()
    for now_ns, (command, body) in enumerate(_requests(data)):
        answer = device.answer(command, body, _CLIENT, now_ns)
        if len(answer.data) > MAX_ANSWER + 8 or not (answer.error_code or len(answer.data) >= 4):
            raise AssertionError(f"an answer of {len(answer.data)} octets")
        for _, notice in device.notifications.handle_cycle(now_ns, now_ns):
            decode_notification(notice)
