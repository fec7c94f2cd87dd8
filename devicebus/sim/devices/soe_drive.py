"""Drives with SoE from a vendor's description: IDNs of the process data and of start-up writes.

Entry (IDN, drive + 1) of the internal dictionary holds the value of an IDN that a PDO maps.  The
lists S-0-0016 and S-0-0024 change the telegrams AT and MDT (IEC 61800-7-300).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from devicebus.errors import SoeError
from devicebus.esi.records import EsiDevice, EsiPdo
from devicebus.mailbox.soe_server import SoeParameter
from devicebus.wire.alstatus import AlState
from eap.codec.soe import (
    AT,
    CONTROL_WORD,
    MDT,
    STATUS_WORD,
    Display,
    Idn,
    SoeAttribute,
    SoeErrorCode,
    name_of,
)
from eap.od.dictionary import ObjectDictionary
from eap.od.model import Entry

# Position and velocity: command value in the MDT, feedback value in the AT.
_FOLLOWERS = ((47, 51), (36, 40))
_ON = 0xE000
_READY, _ENABLED = 0x4000, 0xC000
_LENGTHS = {1: 0, 2: 1, 4: 2, 8: 3}
_NUMBERS = SoeAttribute(
    length=1, is_list=1, display=Display.IDN, protected_safeop=1, protected_op=1
)
_MAX_LIST = 64


class SoeAxes:
    """Axes that are enabled by the master control word and follow their command values."""

    def __init__(self, dictionary: ObjectDictionary, channels: int) -> None:
        self._dictionary = dictionary
        self._channels = channels

    def step(self, state: AlState, now_ns: int) -> None:
        """Follow the control word; out of OP the axes are off."""
        del now_ns
        for drive in range(self._channels):
            control = self._entry(CONTROL_WORD, drive)
            word = control.value if control is not None and state is AlState.OP else 0
            is_enabled = word & _ON == _ON
            status = self._entry(STATUS_WORD, drive)
            if status is not None:
                status.value = _ENABLED if is_enabled else _READY
            for command, feedback in _FOLLOWERS if is_enabled else ():
                target, actual = self._entry(command, drive), self._entry(feedback, drive)
                if target is not None and actual is not None and _same_size(target, actual):
                    actual.octets = target.octets

    def _entry(self, idn: int, drive: int) -> Entry | None:
        return find_value(self._dictionary, idn, drive)


def _same_size(one: Entry, other: Entry) -> bool:
    return one.kind.size == other.kind.size


def find_value(dictionary: ObjectDictionary, idn: int, drive: int) -> Entry | None:
    """Return the entry that holds the value of an IDN, None if no PDO maps it."""
    if idn not in dictionary:
        return None
    return dictionary[idn].entries.get(drive + 1)


def soe_parameters(
    device: EsiDevice, dictionary: ObjectDictionary
) -> dict[int, list[SoeParameter]]:
    """Return the IDNs of each drive of a device."""
    channels = device.mailbox.soe_channels if device.mailbox else 0
    return {drive: list(_parameters(device, dictionary, drive)) for drive in range(channels)}


def _parameters(
    device: EsiDevice, dictionary: ObjectDictionary, drive: int
) -> Iterator[SoeParameter]:
    known: set[int] = set()
    for pdo in device.pdos:
        if pdo.drive != drive:
            continue
        number = MDT if pdo.is_output else AT
        if number not in known:
            known.add(number)
            yield _list(number, pdo, dictionary, drive)
        for each in pdo.entries:
            entry = find_value(dictionary, each.index, drive)
            if entry is None or each.index in known:
                continue
            known.add(each.index)
            attribute = SoeAttribute(length=_LENGTHS.get(entry.kind.size, 2))
            yield SoeParameter(
                str(Idn.of(each.index)), each.name, attribute, read=_reader(entry),
                write=_writer(entry),
            )  # fmt: skip
    for command in device.init_commands:
        if command.is_soe and command.channel == drive and command.index not in known:
            known.add(command.index)
            yield _written(command.index, command.data, command.comment)


def _written(idn: int, data: bytes, comment: str) -> SoeParameter:
    """Return the IDN of a start-up write, with the length of its data."""
    name = comment or str(Idn.of(idn))
    if len(data) in _LENGTHS:
        return SoeParameter(str(Idn.of(idn)), name, SoeAttribute(length=_LENGTHS[len(data)]))
    attribute = SoeAttribute(length=0, is_list=1)
    return SoeParameter(str(Idn.of(idn)), name, attribute, max_length=max(len(data), _MAX_LIST))


def _reader(entry: Entry) -> Callable[[], bytes]:
    return lambda: entry.octets


def _writer(entry: Entry) -> Callable[[bytes], None]:
    def write(octets: bytes) -> None:
        entry.octets = octets

    return write


def _list(number: int, pdo: EsiPdo, dictionary: ObjectDictionary, drive: int) -> SoeParameter:
    """Return the configuration list of a telegram; fixed entries are no part of it."""
    title = "Configuration list of MDT" if pdo.is_output else "Configuration list of AT"
    free = [each.index for each in pdo.entries if not each.is_fixed]
    fixed = [each.index for each in pdo.entries if each.is_fixed]
    mapping = dictionary[pdo.index]

    def write(octets: bytes) -> None:
        idns = [int.from_bytes(octets[at : at + 2], "little") for at in range(0, len(octets), 2)]
        numbers: list[int] = []
        for idn in (*fixed, *idns):
            entry = find_value(dictionary, idn, drive)
            if entry is None or len(numbers) + 1 >= len(mapping.entries):
                code = SoeErrorCode.INVALID_VALUE
                raise SoeError(name_of(code), code=code)
            numbers.append(idn << 16 | drive + 1 << 8 | entry.kind.bit_length)
        for subindex, value in enumerate(numbers, 1):
            mapping.entries[subindex].value = value
        mapping.entries[0].value = len(numbers)

    return SoeParameter(
        str(Idn.of(number)), title, _NUMBERS, free, max_length=_MAX_LIST, write=write
    )
