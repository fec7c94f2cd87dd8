"""The object dictionary of one EAP port: objects that come, change and go in PreOp.

Rule 1: a download to any sub-index of a free index of a dynamic range makes the object, with
defaults for all other entries.
Rule 2: 0 in sub-index 0 empties a mapping and deletes any other dynamic object, unless another
object refers to it.
Rule 3: mappings are checked when they are written, all other references when SafeOp is requested.
Rule 4: what is refused changes nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from eap.codec import pdo
from eap.device import eap_rules
from eap.device.eap_objects import DeviceIdentity, EapObjects, LiveValues
from eap.device.eap_rules import check_mapped, lay_out_mapping
from eap.ids import ObjectId
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.dictionary import ObjectDictionary, check_value, take_bits
from eap.od.model import Access, Entry, OdObject, OdState
from eap.od.profiles import eap1000 as profile
from eap.od.profiles.eap1000 import AddressMode, FrameSub, Rx, Status, Tx, Var
from eap.od.profiles.table import CONFIG, DEFAULT_TYPE, ProfileObject
from eap.pd.device import DeviceFault
from eap.pd.rules import data_budget, frame_budget
from eap.pd.spec import StationSpec


class EapDictionary(EapObjects):
    """Dictionary of one EAP port of a station, for clients to read and to write.

    Args:
        station: The station as it was started: its port is taken from it, nothing else is.
        port: Name of the port.
        live: Where live entries get their values.
        identity: What 0x1000 to 0x1018 show.

    Attributes:
        on_request: Called with the number of the state that a client writes to 0xF200:01.
        on_change: Called with index and sub-index after a client wrote configuration in SafeOp or
            Op, where an object says that this may be done; a DeviceFault refuses it.
    """

    def __init__(
        self,
        station: StationSpec,
        port: str,
        live: LiveValues | None = None,
        identity: DeviceIdentity = DeviceIdentity(),  # noqa: B008  immutable
    ) -> None:
        super().__init__(station, port, live, identity)
        self.on_request: Callable[[int], object] | None = None
        self.on_change: Callable[[int, int], None] | None = None

    def blank(self) -> EapDictionary:
        """Return an empty dictionary of the same port, for which nothing runs."""
        return EapDictionary(self.station, self.port.name, identity=self.identity)

    def show_status(self, word: int, fault: DeviceFault | None) -> None:
        """Show the device's state, and why it is not another one, in 0xF100."""
        entries = self[profile.STATUS].entries
        entries[Status.STATE].value = word
        entries[Status.ERROR_CODE].value = fault.code if fault else 0
        text = fault.text if fault else ""
        entries[Status.ERROR_TEXT].octets = text.encode()[: entries[Status.ERROR_TEXT].kind.size]
        lay_out_mapping = fault.index << 16 | fault.subindex << 8 if fault else 0
        entries[Status.ERROR_OBJECT].value = lay_out_mapping

    def download(self, index: int, subindex: int, data: bytes, state: OdState) -> None:
        """Write one entry; makes and deletes dynamic objects."""
        with self._all_or_nothing(index):
            is_new = self._make_free(index, subindex, state)
            row = profile.row_of(index)
            if is_new and subindex == 0 and data == b"\0" and not row.mapping:
                raise SdoAbortError(AbortCode.NO_OBJECT, index, 0)
            self._write(row, index, subindex, data, state)
            self._settle(row, index, [subindex], state)

    def download_complete(self, index: int, first: int, data: bytes, state: OdState) -> None:
        """Write a whole object; a list becomes as long as sub-index 0 says."""
        with self._all_or_nothing(index):
            self._make_free(index, first, state)
            row = profile.row_of(index)
            self._write_whole(row, index, first, data, state)
            self._settle(row, index, list(self[index].entries) if index in self else [], state)

    def check_download(
        self, index: int, subindex: int, size: int, state: OdState, *, complete: bool = False
    ) -> None:
        """Refuse what can be refused before the data of a download is there."""
        row = profile.find(index)
        if row is None or not (row.dynamic or (row.list_row and index in self)):
            super().check_download(index, subindex, size, state, complete=complete)
            return
        self._check_making(index, subindex, state)
        is_there = index in self and row in profile.VARIABLES
        kind = self[index].entries[Var.DEFAULT].kind if is_there else DEFAULT_TYPE
        largest = self.make_object(row, index, kind, row.last_subindex)
        for number, entry in self._objects.get(index, largest).entries.items():
            largest.entries[number].access = entry.access
        ObjectDictionary([largest]).check_download(index, subindex, size, state, complete=complete)

    @contextmanager
    def _all_or_nothing(self, index: int) -> Iterator[None]:
        item = self._objects.get(index)
        saved = [
            (subindex, entry, b"" if entry.read else entry.octets, entry.access)
            for subindex, entry in (item.entries.items() if item is not None else ())
        ]
        try:
            yield
        except SdoAbortError:
            if item is None:
                self.remove(index)
            else:
                item.entries = {subindex: entry for subindex, entry, _, _ in saved}
                for _, entry, octets, access in saved:
                    entry.access = access
                    if entry.read is None:
                        entry.octets = octets
            raise

    def _check_making(self, index: int, subindex: int, state: OdState) -> None:
        if index not in self and state is not OdState.PREOP:
            detail = "objects are made in PreOp"
            raise SdoAbortError(AbortCode.DEVICE_STATE, index, subindex, detail)

    def _make_free(self, index: int, subindex: int, state: OdState) -> bool:
        """Make the object at *index* if it is a dynamic one that is not there."""
        row = profile.find(index)
        if index in self or row is None or not row.dynamic:
            _ = self[index]  # refuses what is not there
            return False
        self._check_making(index, subindex, state)
        self.make(row, index)
        return True

    def _write_whole(
        self, row: ProfileObject, index: int, first: int, data: bytes, state: OdState
    ) -> None:
        self._whole(index, first)  # refuses what has no complete access
        item = self[index]
        count = item.max_subindex
        has_count = first == 0 and is_counted(item)
        if first == 0:
            if len(data) < 2:
                raise SdoAbortError(AbortCode.TOO_SHORT, index, 0, "sub-index 0 takes two octets")
            count, data = data[0] if has_count else count, data[2:]
        if has_count:
            if count == 0 and data:
                raise SdoAbortError(AbortCode.TOO_LONG, index, 0, "nothing follows a 0")
            self._make_room(row, item, count, state)
            if index not in self:
                return
        chosen = [(sub, each) for sub, each in item.entries.items() if 1 <= sub <= count]
        for subindex, octets in _part(index, chosen, data, state):
            self._write(row, index, subindex, octets, state)
        if has_count and row.mapping:
            self._write_count(row, item, bytes((count,)), state)

    def _make_room(self, row: ProfileObject, item: OdObject, count: int, state: OdState) -> None:
        """Empty what can be emptied and make place for *count* entries; 0 may delete it all."""
        if row.mapping:
            self._write_count(row, item, b"\0", state)
            self.grow(item.index, min(count, profile.MAX_ENTRIES))
        else:
            self._write_count(row, item, bytes((count,)), state)

    def _write(
        self, row: ProfileObject, index: int, subindex: int, data: bytes, state: OdState
    ) -> None:
        item = self[index]
        if subindex == 0 and is_counted(item):
            self._write_count(row, item, data, state)
            return
        list_row = row.list_row
        if list_row and max(item.entries) < subindex <= list_row.last:
            if row.mapping:
                self.grow(index, subindex)
            else:
                self.resize(index, subindex)
        ObjectDictionary.check_download(self, index, subindex, len(data), state)
        entry = item.entries[subindex]
        if row.mapping:
            self._check_mapping_entry(row, item, subindex, data)
        check_value(entry, index, subindex, data)
        try:
            data = eap_rules.checked(row, subindex, entry, data)
        except ValueError as exc:
            raise SdoAbortError(AbortCode.VALUE, index, subindex, str(exc)) from None
        if row in profile.VARIABLES and subindex == Var.TYPE_NAME and data != entry.octets:
            self._check_unused(index, subindex)
        if row is profile.RX_PD and subindex == Rx.PUBLISHER and data != entry.octets:
            self.put(index, Rx.SOURCE, b"")  # it was the address of the publisher before
        self.put(index, subindex, data)

    def _write_count(self, row: ProfileObject, item: OdObject, data: bytes, state: OdState) -> None:
        """Write sub-index 0: the length of a list or a mapping, or 0 to delete or empty."""
        index = item.index
        ObjectDictionary.check_download(self, index, 0, len(data), state)
        count = data[0]
        if row.mapping:
            if count > max(item.entries):
                detail = f"{max(item.entries)} entries are written"
                raise SdoAbortError(AbortCode.NO_SUBINDEX, index, count, detail)
            for subindex in range(1, count + 1):
                check_mapped(self, item.entries[subindex].value, _right(row), index, subindex)
            lay_out_mapping(self, index, count, data_budget(self.uri.scheme))
        elif count == 0 and row.dynamic:
            self._check_unused(index, 0)
            self.remove(index)
            return
        elif not row.fixed_count <= count <= row.last_subindex:
            detail = f"{count}, expected {row.fixed_count} to {row.last_subindex}"
            detail += ", or 0 to delete the object" if row.dynamic else ""
            raise SdoAbortError(AbortCode.VALUE, index, 0, detail)
        self.resize(index, count)

    def _check_mapping_entry(
        self, row: ProfileObject, item: OdObject, subindex: int, data: bytes
    ) -> None:
        if item.max_subindex:
            raise SdoAbortError(AbortCode.SUBINDEX_0_NOT_ZERO, item.index, subindex)
        word = int.from_bytes(data, "little")
        check_mapped(self, word, _right(row), item.index, subindex)

    def _check_unused(self, index: int, subindex: int) -> None:
        user = self.user_of(index)
        if user is not None:
            is_mapped = profile.row_of(index) in profile.VARIABLES
            code = AbortCode.MAPPED if is_mapped else AbortCode.PARAMETER
            detail = f"{ObjectId(*user)} refers to it"
            raise SdoAbortError(code, index, subindex, detail)

    def _settle(self, row: ProfileObject, index: int, written: list[int], state: OdState) -> None:
        """Check what written entries mean for frames, and tell those who want to know."""
        if index not in self:
            return
        frames = {
            frame: subindex
            for subindex in reversed(written)
            for frame in self._frames_to_check(row, index, subindex)
        }
        for frame, subindex in frames.items():
            self._check_budget(frame, index, subindex)
        if index == profile.CONTROL:
            if self.on_request is not None:
                self.on_request(self[index].entries[1].value)
        elif state is not OdState.PREOP and self.on_change is not None:
            try:
                self.on_change(index, written[0])
            except DeviceFault as exc:
                raise SdoAbortError(AbortCode.PARAMETER, index, written[0], str(exc)) from None

    def _frames_to_check(self, row: ProfileObject, index: int, subindex: int) -> list[int]:
        """Return the frames whose length or budget the entry has a part in."""
        if row is profile.TX_FRAME:
            return [index] if subindex >= FrameSub.TXPD or subindex == FrameSub.ADDRESS_MODE else []
        if row is profile.TX_PD and subindex == Tx.PDO_INDEX:
            wanted = {index}
        elif row in {profile.TX_PDO, profile.MORE_TX_PDO} and subindex == 0:
            pds = self.members(profile.TX_PD)
            wanted = {pd for pd in pds if self[pd].entries[Tx.PDO_INDEX].value == index}
        else:
            return []
        return [
            frame
            for frame in (self.members(profile.TX_FRAME) if wanted else ())
            if any(pd in wanted for _, pd in self.listed_pds(frame))
        ]

    def _check_budget(self, frame: int, index: int, subindex: int) -> None:
        length = self.frame_length(frame)
        mode = AddressMode(self[frame].entries[FrameSub.ADDRESS_MODE].value)
        budget = frame_budget(self.uri.scheme, mode.kind)
        if length > budget:
            detail = f"{self.name_of(frame)} would have {length} octets, at most {budget} go there"
            raise SdoAbortError(AbortCode.PDO_LENGTH, index, subindex, detail)


def is_counted(item: OdObject) -> bool:
    """Tell whether writing sub-index 0 of *item* means something."""
    return item.entries[0].access == CONFIG


def _right(row: ProfileObject) -> Access:
    is_sent = row in {profile.TX_PDO, profile.MORE_TX_PDO}
    return Access.TX_MAPPABLE if is_sent else Access.RX_MAPPABLE


def _part(
    index: int, chosen: list[tuple[int, Entry]], data: bytes, state: OdState
) -> Iterator[tuple[int, bytes]]:
    """Yield the octets of each of *chosen* that can be written, out of a complete access."""
    plan = pdo.layout([entry.kind for _, entry in chosen])
    if len(data) != plan.size:
        code = AbortCode.TOO_SHORT if len(data) < plan.size else AbortCode.TOO_LONG
        raise SdoAbortError(code, index, 1, f"{len(data)} octets for entries of {plan.size}")
    if chosen and not any(entry.access & state.write_right for _, entry in chosen):
        writable = any(entry.access & Access.WRITE_ANY for _, entry in chosen)
        code = AbortCode.DEVICE_STATE if writable else AbortCode.READ_ONLY
        raise SdoAbortError(code, index, 1)
    for (subindex, entry), offset in zip(chosen, plan.bit_offsets, strict=True):
        if entry.access & state.write_right:
            yield subindex, take_bits(data, offset, entry.kind)
