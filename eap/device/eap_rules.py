"""Rules of the objects of EAP ports: content of entries, mappings, and the station as a whole.

Each content rule receives the bytes of a download and returns them as they are to be stored, or
raises ValueError with the reason; the dictionary turns that into an SDO abort.

A mapping entry is index, sub-index and bit length in 16, 8 and 8 bits.  Bits pack, everything else
starts on a whole byte, so a mapping has padding (index 0) exactly where bits end inside a byte and
something else follows; at the end it may be left out.

The rules of the whole station are those of a plant file (``eap.pd.rules``), as far as one station
can break them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from typing import Any, NamedTuple

from eap.codec import datatypes
from eap.codec.datatypes import DataType, is_finite, variable_of
from eap.ids import Destination, InterfaceUri, MacAddr, ObjectId
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import Access, Entry, OdObject
from eap.od.profiles import eap1000 as profile
from eap.od.profiles.eap1000 import MAX_ENTRIES, WHOLE, FrameSub, Rx, RxFlag, Tx
from eap.od.profiles.table import ProfileObject, Rule
from eap.pd import rules
from eap.pd.address import address_text, source_octets
from eap.pd.device import DeviceFault, FaultCode
from eap.pd.rules import MADE_SUFFIXES, NAME, RuleViolation, is_group, is_name
from eap.pd.spec import (
    REQUESTER,
    EngineSource,
    RxPdSpec,
    StationSpec,
    TxFrameSpec,
    TxPdSpec,
    Writer,
)

REQUESTED = frozenset({2, 4, 8})
"""States that a client can request; Init cannot be requested."""
_BOOL = 0x01


def checked(row: ProfileObject, subindex: int, entry: Entry, data: bytes) -> bytes:
    """Return *data* as *entry* at *subindex* of one of *row*'s objects stores it."""
    if entry.is_text:
        data = _text(data)
    list_row = row.list_row
    first = list_row.subindex if list_row and subindex >= list_row.subindex else subindex
    ruled = _RULED.get((row.first, first))
    if ruled is not None and ruled.refers:
        _check_reference(int.from_bytes(data, "little"), ruled.refers)
    elif ruled is not None:
        data = _RULES[ruled.rule](data, entry)
    elif entry.kind.code == _BOOL:
        # Any value but 0 is true; it reads back as 1.
        data = bytes((data != b"\0",))
    return data


def _text(data: bytes) -> bytes:
    # Clients pad texts to the length of the entry.
    data = data.rstrip(b"\0")
    if 0 in data:
        raise ValueError("text with a NUL in it")
    try:
        data.decode()
    except UnicodeDecodeError:
        raise ValueError("text is no UTF-8") from None
    return data


def _check_reference(index: int, ranges: tuple[int, ...]) -> None:
    if not index:
        return
    rows = [profile.row_of(first) for first in ranges]
    if not any(row.first <= index <= row.last for row in rows):
        expected = " or ".join(f"0x{row.first:04X} to 0x{row.last:04X}" for row in rows)
        raise ValueError(f"0x{index:04X} cannot be referred to here: {expected}, or 0 for none")


def _name(data: bytes, _entry: Entry) -> bytes:
    name = data.decode()
    # The names become names in the plant file and on the command line.
    if not is_name(name):
        raise ValueError(f"{name!r} is no name: {NAME}")
    if name.endswith(MADE_SUFFIXES):
        raise ValueError(f"{name!r}: {' and '.join(MADE_SUFFIXES)} are made by the appliance")
    return data


def _type(data: bytes, _entry: Entry) -> bytes:
    # In its canonical text, so that two writings of one type compare as equal.
    return datatypes.parse(data.decode()).text.encode()


def _flags(data: bytes, _entry: Entry) -> bytes:
    known = RxFlag.ENABLED | RxFlag.IGNORE_NETID | RxFlag.IGNORE_VERSION
    # A flag of a later release must not be stored without an effect.
    if data[0] & ~known:
        raise ValueError(f"flags 0x{data[0]:02X}: of the flags 0x{known:02X} only")
    return data


def _default(data: bytes, entry: Entry) -> bytes:
    value = entry.kind.decode(data.ljust(entry.kind.size, b"\0"), 0)
    if not is_finite(value):
        raise ValueError("a default is a finite number")
    # It is kept as text, from which every part of it has to be read again.
    entry.kind.from_plain(entry.kind.to_plain(value))
    # A bit field is stored without the bits beyond it.
    return entry.kind.encode(value) if entry.kind.is_bits else data


def _group(data: bytes, _entry: Entry) -> bytes:
    text = data.decode()
    if text and not (is_group(text, "ethernet") or is_group(text, "udp")):
        raise ValueError(f"{text!r} is no multicast address (MAC or IPv4)")
    # One form of an address, so that equal groups compare as equal.
    return str(MacAddr.parse(text)).encode() if ":" in text or "-" in text else data


def _state(data: bytes, _entry: Entry) -> bytes:
    state = int.from_bytes(data, "little")
    if state not in REQUESTED:
        raise ValueError(f"{state} cannot be requested: 2 PreOp, 4 SafeOp or 8 Op")
    return data


def _source(data: bytes, _entry: Entry) -> bytes:
    text = data.decode()
    try:
        return address_text(source_octets(text)).encode() if text else data
    except ValueError:
        raise ValueError(f"{text!r} is no MAC and no IPv4 address") from None


_RULED = {
    (row.first, each.subindex): each
    for row in profile.ALL
    for each in row.entries
    if each.refers or each.rule is not Rule.NONE
}
_RULES: dict[Rule, Callable[[bytes, Entry], bytes]] = {
    Rule.NAME: _name,
    Rule.TYPE: _type,
    Rule.DEFAULT: _default,
    Rule.FLAGS: _flags,
    Rule.GROUP: _group,
    Rule.SOURCE: _source,
    Rule.STATE: _state,
}


class MappingEntry(NamedTuple):
    """One mapping entry."""

    target: int
    """Index of the object; 0 is padding."""
    subindex: int
    bits: int

    @classmethod
    def decode(cls, word: int) -> MappingEntry:
        """Decode the 32 bits of a mapping entry."""
        return cls(word >> 16, word >> 8 & 0xFF, word & 0xFF)

    def encode(self) -> int:
        """Return the mapping entry as 32 bits."""
        return self.target << 16 | self.subindex << 8 | self.bits


class MappingLayout(NamedTuple):
    """Variables and size of a whole mapping."""

    indexes: tuple[int, ...]
    """Objects of the variables, in order."""
    octets: int


def encode_mapping(variables: Iterable[tuple[int, DataType]]) -> list[int]:
    """Return the entries that map *variables* (index of the object, type), padding included.

    Raises:
        ValueError: there are more entries than a mapping has.
    """
    words: list[int] = []
    end = 0
    for index, kind in variables:
        if not kind.is_bits and end % 8:
            gap = -end % 8
            words.append(MappingEntry(0, 0, gap).encode())
            end += gap
        # The length field has 8 bits; WHOLE marks every longer variable.
        words.append(MappingEntry(index, 1, min(kind.bit_length, WHOLE)).encode())
        end += kind.bit_length
    if len(words) > MAX_ENTRIES:
        raise ValueError(
            f"a mapping has at most {MAX_ENTRIES} entries, this PD needs {len(words)} "
            f"(padding included)"
        )
    return words


def check_mapped(
    dictionary: ObjectDictionary, word: int, right: Access, index: int, subindex: int
) -> None:
    """Abort if an entry maps a missing object, one not mappable with *right*, or another size.

    Raises:
        SdoAbortError: NO_OBJECT, NO_SUBINDEX, NOT_STORED, NOT_MAPPABLE or LENGTH.
    """
    mapped = MappingEntry.decode(word)
    if not mapped.target:
        # Eight bits or more would be a gap that no variable needs.
        if mapped.subindex or not 0 < mapped.bits < 8:
            detail = f"padding of sub-index {mapped.subindex} and {mapped.bits} bits"
            raise SdoAbortError(AbortCode.NOT_MAPPABLE, index, subindex, f"{detail}: 1 to 7 bits")
        return
    try:
        entry = dictionary.entry(mapped.target, mapped.subindex)
    except SdoAbortError as exc:
        raise SdoAbortError(exc.code, index, subindex, f"maps {exc}") from None
    what = f"{ObjectId(mapped.target, mapped.subindex)} ({entry.name})"
    if not entry.access & right:
        raise SdoAbortError(AbortCode.NOT_MAPPABLE, index, subindex, what)
    expected = min(entry.kind.bit_length, WHOLE)
    if mapped.bits != expected:
        detail = (
            f"{what} is {entry.kind.name}, mapped with {mapped.bits} bits instead of {expected}"
        )
        raise SdoAbortError(AbortCode.LENGTH, index, subindex, detail)


def lay_out_mapping(
    dictionary: ObjectDictionary, index: int, count: int, limit: int
) -> MappingLayout:
    """Return the layout of the first *count* entries of the mapping at *index*.

    Raises:
        SdoAbortError: PARAMETER for padding that is missing or too much, PDO_LENGTH for more than
            *limit* bytes, and what :meth:`ObjectDictionary.entry` raises for removed objects.
    """
    entries = dictionary[index].entries
    indexes = []
    end = 0
    for subindex in range(1, count + 1):
        mapped = MappingEntry.decode(entries[subindex].value)
        if not mapped.target:
            follows = subindex < count and _is_whole(dictionary, entries[subindex + 1].value)
            if end % 8 + mapped.bits != 8 or not (follows or subindex == count):
                detail = f"{mapped.bits} bits of padding behind {end} bits are not needed"
                raise SdoAbortError(AbortCode.PARAMETER, index, subindex, detail)
            end += mapped.bits
            continue
        kind = dictionary.entry(mapped.target, mapped.subindex).kind
        if not kind.is_bits and end % 8:
            detail = f"{kind.name} behind {end} bits: {-end % 8} bits of padding are missing"
            raise SdoAbortError(AbortCode.PARAMETER, index, subindex, detail)
        indexes.append(mapped.target)
        end += kind.bit_length
    octets = -(-end // 8)
    if octets > limit:
        detail = f"{octets} bytes, the largest frame of this port holds {limit}"
        raise SdoAbortError(AbortCode.PDO_LENGTH, index, 0, detail)
    return MappingLayout(tuple(indexes), octets)


def mapped_bits(dictionary: ObjectDictionary, item: OdObject) -> int:
    """Return the bits of the active entries of a mapping whose targets exist."""
    bits = 0
    for subindex in range(1, item.max_subindex + 1):
        mapped = MappingEntry.decode(item.entries[subindex].value)
        if mapped.target in dictionary:
            bits += dictionary[mapped.target].entries[mapped.subindex].kind.bit_length
        elif not mapped.target:
            bits += mapped.bits
    return bits


def _is_whole(dictionary: ObjectDictionary, word: int) -> bool:
    mapped = MappingEntry.decode(word)
    return bool(mapped.target) and not dictionary.entry(mapped.target, mapped.subindex).kind.is_bits


class FoundRecord(NamedTuple):
    """A record with the port and index of its object; of a TxPD also the record of its frame."""

    port: str
    at: int
    """Index of its object."""
    record: Any
    frame: Any = None

    def fault(self, code: FaultCode, detail: str, subindex: int = 0) -> DeviceFault:
        """Make a fault about it."""
        return DeviceFault(code, detail, self.at, subindex, self.port)

    def refuse(self, breaches: Iterable[RuleViolation]) -> None:
        """Raise a DeviceFault for the first of *breaches*, at the entry that it names."""
        for breach in breaches:
            raise fault_of(breach, self.at, self.port)


def fault_of(breach: RuleViolation, index: int, port: str) -> DeviceFault:
    """Return the fault for *breach* at the object of *index*."""
    subindex = profile.row_of(index).subindex_of(breach.entry or breach.key)
    detail = f"{breach.message}; expected {breach.expected}"
    return DeviceFault(breach.code, detail, index, subindex, port)


def check_station(
    before: StationSpec,
    spec: StationSpec,
    frames: list[FoundRecord],
    pds: list[FoundRecord],
    subscriptions: list[FoundRecord],
) -> None:
    """Check that the engine can run a station.

    Args:
        before: The station with the sources and links.
        spec: The specification that was read back.
        frames: Its TxFrames.
        pds: Its TxPDs.
        subscriptions: Its RxPDs.

    Raises:
        DeviceFault: for the first object that is wrong.
    """
    _check_unique(frames, FrameSub.NAME, "frame")
    _check_unique(pds, Tx.NAME, "sent PD")
    _check_unique(subscriptions, Rx.NAME, "received PD")
    uris = {port.name: port.interface for port in spec.ports}
    for found in frames:
        found.refuse(_breaches_of_frame(found.record, uris[found.port]))
    for found in pds:
        found.refuse(_breaches_of_pd(found.record, found.frame.record, spec.cycle_us))
    for second, first in rules.duplicates(((each.port, each.record.pd_id), each) for each in pds):
        detail = f"{second.record.pd_id} is that of {first.record.name} too"
        raise second.fault(FaultCode.PD_ID_TWICE, detail, Tx.PD_ID)
    _check_received(spec, subscriptions)
    _check_polls(pds, subscriptions)
    _check_station_needs(before, spec, subscriptions)


def _check_unique(found: Iterable[FoundRecord], subindex: int, what: str) -> None:
    for second, first in rules.duplicates((each.record.name, each) for each in found):
        detail = f"{what} {first.record.name} is 0x{first.at:04X} of {first.port} already"
        raise second.fault(FaultCode.NAME_TWICE, detail, subindex)


def _breaches_of_frame(frame: TxFrameSpec, uri: InterfaceUri) -> Iterator[RuleViolation]:
    is_answer = frame.destination == REQUESTER
    destination = None if is_answer else Destination.parse(frame.destination)
    return chain(
        # A dictionary cannot tell "no modulo" from 0.
        rules.check_frame(frame, frame.modulo or None),
        chain.from_iterable(rules.check_frame_of(pd, frame) for pd in frame.pds),
        rules.check_monitoring(frame, destination, uri),
    )


def _breaches_of_pd(pd: TxPdSpec, frame: TxFrameSpec, cycle_us: int) -> Iterator[RuleViolation]:
    return chain(
        rules.check_pd(pd, pd.trigger.modulo or None),
        rules.check_times(pd, frame, cycle_us),
    )


def _check_received(spec: StationSpec, subscriptions: Iterable[FoundRecord]) -> None:
    # Not the rule of the plant file: while a sender changes, its old and its new version are taken
    # side by side.
    seen: dict[tuple[str, str, int], list[RxPdSpec]] = {}
    taken: dict[str, str] = {}
    for each in subscriptions:
        pd: RxPdSpec = each.record
        for name in pd.variables:
            if name in taken:
                detail = f"variable {name}, by {taken[name]} too"
                raise each.fault(FaultCode.RECEIVED_TWICE, detail, Rx.PDO_INDEX)
            taken[name] = pd.name
        same = seen.setdefault((pd.port, pd.publisher, pd.pd_id), [])
        for other in same:
            if pd.ignore_version or other.ignore_version or pd.version == other.version:
                detail = f"id {pd.pd_id} of {pd.publisher or 'any publisher'}, by {other.name} too"
                raise each.fault(FaultCode.RECEIVED_TWICE, detail, Rx.PD_ID)
        same.append(pd)
        each.refuse(rules.check_time_out(pd.name, pd.timeout_ms, spec.cycle_us))


def _check_polls(pds: list[FoundRecord], subscriptions: list[FoundRecord]) -> None:
    """Raise a fault for poll requests that are missing or are answers themselves."""
    sent = {(each.port, each.record.name): each.record for each in pds}
    received = {(each.port, each.record.name): each.record for each in subscriptions}
    for found, others, subindex in (
        *((each, received, Tx.POLL_REQUEST_RXPD) for each in pds),
        *((each, sent, Rx.POLL_REQUEST_TXPD) for each in subscriptions),
    ):
        request = found.record.poll_request
        if not request:
            continue
        other = others.get((found.port, request))
        if other is None:
            raise found.fault(FaultCode.POLL, f"{request} is not enabled", subindex)
        if other.poll_request:
            raise found.fault(FaultCode.POLL, f"{request} is an answer itself", subindex)
    for found in subscriptions:
        if found.record.poll_request and found.record.step:
            raise found.fault(FaultCode.POLL, "an answer has no fixed step", Rx.STEP)


def _check_station_needs(
    before: StationSpec, spec: StationSpec, subscriptions: Iterable[FoundRecord]
) -> None:
    """Raise a fault for variables that do not fit the sources and links of the station."""
    now = {each.name: each for each in spec.variables}
    types = {each.name: each.type for each in before.variables}
    received = {name for each in subscriptions for name in each.record.variables}
    writers: dict[str, Writer] = {}
    for source in before.sources:
        is_engine = isinstance(source, EngineSource)
        writer = Writer.ENGINE if is_engine else Writer.SERVICES
        writers[variable_of(source.variable, types)] = writer
    writers |= {variable_of(link.target, types): Writer.ENGINE for link in before.links}
    read = (variable_of(link.source, types) for link in before.links)
    for name in dict.fromkeys([*writers, *read]):
        if name not in now:
            raise DeviceFault(FaultCode.IN_USE, f"a source or a link needs {name}")
        if now[name].type != types.get(name, now[name].type):
            is_now, needed = (datatypes.parse(each).name for each in (now[name].type, types[name]))
            detail = f"{name} is {is_now}, a source or a link needs {needed}"
            raise DeviceFault(FaultCode.IN_USE, detail)
        if name in writers and (name in received or now[name].writer is not writers[name]):
            detail = f"{name} is filled by a source or a link"
            raise DeviceFault(FaultCode.WRITER, detail)
