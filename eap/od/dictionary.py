"""Object dictionary: SDO semantics, access rights by state, and abort codes.

Every method raises :class:`eap.od.abort.SdoAbortError` and leaves the dictionary as it was, or
succeeds.  Data is in the form in which CoE transfers it (ETG.1000.6).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext

from eap.codec import datatypes
from eap.codec.datatypes import DataType
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.model import Access, Entry, OdObject, OdState


class ObjectDictionary:
    """The objects of one device, by index.

    Attributes:
        describes_values: Whether entry descriptions hold units, defaults and limits on request.
    """

    describes_values = True

    def __init__(self, objects: Iterable[OdObject] = ()) -> None:
        self._objects: dict[int, OdObject] = {}
        for item in objects:
            self.add(item)

    def add(self, item: OdObject) -> None:
        """Add an object or put it in the place of the one of its index."""
        self._objects[item.index] = item

    def remove(self, index: int) -> None:
        """Remove the object at *index*, if there is one."""
        self._objects.pop(index, None)

    def __contains__(self, index: int) -> bool:
        return index in self._objects

    def __getitem__(self, index: int) -> OdObject:
        """Return the object at *index*; refuse with NO_OBJECT."""
        try:
            return self._objects[index]
        except KeyError:
            raise SdoAbortError(AbortCode.NO_OBJECT, index, 0) from None

    def __iter__(self) -> Iterator[OdObject]:
        """Yield the objects in the order of their indexes."""
        return (self._objects[index] for index in sorted(self._objects))

    def __len__(self) -> int:
        return len(self._objects)

    def entry(self, index: int, subindex: int) -> Entry:
        """Return one entry; refuse gaps with NOT_STORED, what lies behind with NO_SUBINDEX."""
        item = self[index]
        try:
            return item.entries[subindex]
        except KeyError:
            # As IgH answers: a gap exists but has no data, an index above the last does not exist.
            gap = subindex <= item.max_subindex
            code = AbortCode.NOT_STORED if gap else AbortCode.NO_SUBINDEX
            raise SdoAbortError(code, index, subindex) from None

    def upload(self, index: int, subindex: int, state: OdState) -> bytes:
        """Return the bytes of one entry as a client in *state* may read them."""
        entry = self.entry(index, subindex)
        _check_readable(entry, index, subindex, state)
        return entry.octets

    def download(self, index: int, subindex: int, data: bytes, state: OdState) -> None:
        """Write the bytes of one entry."""
        entry = self.entry(index, subindex)
        _check_writable(entry, index, subindex, state)
        check_value(entry, index, subindex, data)
        _store(entry, index, subindex, data)

    def check_download(
        self, index: int, subindex: int, size: int, state: OdState, *, complete: bool = False
    ) -> None:
        """Refuse what can be refused before the data of a download is there.

        A transfer in segments is so refused at its first message, not at its last.
        """
        if complete:
            chosen = self._whole(index, subindex, count=0xFF)
            limit = datatypes.layout([entry.kind for _, entry in chosen]).size + 2 * (subindex == 0)
            if size > limit:
                raise SdoAbortError(
                    AbortCode.TOO_LONG, index, subindex, f"{size} bytes for entries of {limit}"
                )
            _check_any_writable([entry for _, entry in chosen], index, subindex, state)
        else:
            entry = self.entry(index, subindex)
            _check_writable(entry, index, subindex, state)
            _check_size(entry, index, subindex, size)

    def upload_complete(self, index: int, first: int, state: OdState) -> bytes:
        """Return a whole object from subindex *first* (0 or 1) on; subindex 0 takes 16 bits.

        Gaps and entries that may not be read now are left out, and are zero, respectively.
        """
        chosen = self._whole(index, first)
        # Gaps take no place, as KickCAT and pyetg1510 have it.
        plan = datatypes.layout([entry.kind for _, entry in chosen])
        data = bytearray(plan.size)
        with self.consistent_values():
            for (_, entry), bit_offset in zip(chosen, plan.bit_offsets, strict=True):
                if entry.access & state.read_right:
                    _put_bits(data, bit_offset, entry)
        return bytes(_count_word(self[index]) + data if first == 0 else data)

    def consistent_values(self) -> AbstractContextManager[None]:
        """Have the values that change by themselves be of one moment for the length of a block."""
        return nullcontext()

    def download_complete(self, index: int, first: int, data: bytes, state: OdState) -> None:
        """Write a whole object from subindex *first* on; read-only entries are passed over.

        Where subindex 0 can be written, it says how many entries follow, and is 0 while they are
        written.  All values are checked before the first is stored.
        """
        count = self._new_count(index, first, data, state)
        chosen = self._whole(index, first, count=count)
        if first == 0:
            data = data[2:]
        plan = datatypes.layout([entry.kind for _, entry in chosen])
        if len(data) != plan.size:
            short = len(data) < plan.size
            code = AbortCode.TOO_SHORT if short else AbortCode.TOO_LONG
            raise SdoAbortError(code, index, first, f"{len(data)} bytes for entries of {plan.size}")
        accepted = []
        for (subindex, entry), bit_offset in zip(chosen, plan.bit_offsets, strict=True):
            # Read-only entries are part of the data too, and ignored.
            if not entry.access & state.write_right:
                continue
            octets = extract_bits(data, bit_offset, entry.kind)
            check_value(entry, index, subindex, octets)
            accepted.append((subindex, entry, octets))
        if count is not None:
            counter = self[index].entries[0]
            # With subindex 0 at 0 a half-written list is never used.
            accepted = [(0, counter, b"\0"), *accepted, (0, counter, bytes((count,)))]
        else:
            _check_any_writable([entry for _, entry in chosen], index, first, state)
        for subindex, entry, octets in accepted:
            _store(entry, index, subindex, octets)

    def _new_count(self, index: int, first: int, data: bytes, state: OdState) -> int | None:
        item = self[index]
        if first or not item.complete_access or not item.entries[0].access & state.write_right:
            return None
        if len(data) < 2:
            raise SdoAbortError(AbortCode.TOO_SHORT, index, 0, "subindex 0 takes two bytes")
        check_value(item.entries[0], index, 0, data[:1])
        if data[0] > max(item.entries):
            raise SdoAbortError(AbortCode.NO_SUBINDEX, index, data[0])
        return data[0]

    def _whole(
        self, index: int, first: int, *, count: int | None = None
    ) -> list[tuple[int, Entry]]:
        item = self[index]
        if not item.complete_access:
            raise SdoAbortError(AbortCode.NO_COMPLETE_ACCESS, index, first)
        if first > 1:
            raise SdoAbortError(
                AbortCode.UNSUPPORTED_ACCESS, index, first, "complete access starts at 0 or 1"
            )
        last = item.max_subindex if count is None else count
        return [(sub, entry) for sub, entry in item.entries.items() if 1 <= sub <= last]


def _count_word(item: OdObject) -> bytes:
    # Subindex 0 takes 16 bits in complete access (ETG.1000.6): its byte and one of padding.
    return bytes((item.max_subindex, 0))


def _check_readable(entry: Entry, index: int, subindex: int, state: OdState) -> None:
    if not int(entry.access) & int(state.read_right):  # operators of flags are slow
        readable = entry.access & Access.READ_ANY
        code = AbortCode.DEVICE_STATE if readable else AbortCode.WRITE_ONLY
        raise SdoAbortError(code, index, subindex)


def _check_writable(entry: Entry, index: int, subindex: int, state: OdState) -> None:
    if not entry.access & state.write_right:
        writable = entry.access & Access.WRITE_ANY
        code = AbortCode.DEVICE_STATE if writable else AbortCode.READ_ONLY
        raise SdoAbortError(code, index, subindex)


def _check_any_writable(entries: list[Entry], index: int, first: int, state: OdState) -> None:
    if not any(entry.access & state.write_right for entry in entries):
        writable = any(entry.access & Access.WRITE_ANY for entry in entries)
        code = AbortCode.DEVICE_STATE if writable else AbortCode.READ_ONLY
        raise SdoAbortError(code, index, first)


def _check_size(entry: Entry, index: int, subindex: int, given: int) -> None:
    if given == entry.kind.size or (given < entry.kind.size and entry.is_text):
        return
    code = AbortCode.TOO_LONG if given > entry.kind.size else AbortCode.TOO_SHORT
    raise SdoAbortError(code, index, subindex, f"{given} bytes for {entry.kind.text}")


def check_value(entry: Entry, index: int, subindex: int, data: bytes) -> None:
    """Refuse what has not the size of *entry* or is beyond its limits, rights aside.

    Raises:
        SdoAbortError: TOO_LONG, TOO_SHORT, TOO_HIGH or TOO_LOW.
    """
    _check_size(entry, index, subindex, len(data))
    if entry.minimum is None and entry.maximum is None:
        return
    value = entry.kind.decode(data, 0)
    if not isinstance(value, (int, float)):
        return
    if entry.maximum is not None and value > entry.maximum:
        raise SdoAbortError(AbortCode.TOO_HIGH, index, subindex, f"{value} > {entry.maximum}")
    if entry.minimum is not None and value < entry.minimum:
        raise SdoAbortError(AbortCode.TOO_LOW, index, subindex, f"{value} < {entry.minimum}")


def _store(entry: Entry, index: int, subindex: int, data: bytes) -> None:
    if entry.write is not None:
        try:
            entry.write(data)
        except ValueError as exc:
            raise SdoAbortError(AbortCode.VALUE, index, subindex, str(exc)) from None
    entry.octets = data


def _put_bits(data: bytearray, bit_offset: int, entry: Entry) -> None:
    offset, bit = divmod(bit_offset, 8)
    octets = entry.octets
    if not entry.kind.is_bits:
        data[offset : offset + len(octets)] = octets
        return
    value = (octets[0] & (1 << entry.kind.bit_length) - 1) << bit
    data[offset] |= value & 0xFF
    if value > 0xFF:
        data[offset + 1] |= value >> 8


def extract_bits(data: bytes, bit_offset: int, kind: DataType) -> bytes:
    """Return the bytes of an entry of type *kind* out of the data of a complete access."""
    offset, bit = divmod(bit_offset, 8)
    if not kind.is_bits:
        octets = data[offset : offset + kind.size]
        return octets.rstrip(b"\0") if kind.is_text else octets
    word = int.from_bytes(data[offset : offset + 2], "little") >> bit
    return bytes((word & (1 << kind.bit_length) - 1,))
