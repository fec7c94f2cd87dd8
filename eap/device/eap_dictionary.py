"""Object dictionary of one EAP port: objects that clients create, change and delete in PreOp.

Rule 1: a download to any sub-index of a free index of a dynamic range creates the object, with
defaults for all other entries.
Rule 2: 0 in sub-index 0 empties a mapping and deletes any other dynamic object, unless another
object refers to it.
Rule 3: mappings are checked when they are written, all other references when SafeOp is requested.
Rule 4: a download that is refused changes nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from typing import NamedTuple, Protocol

from eap.codec import datatypes
from eap.codec.datatypes import DataType
from eap.codec.pd import FIRST_PD, PdHeader
from eap.device import eap_rules
from eap.device.eap_rules import MappingEntry, check_mapped, lay_out_mapping, mapped_bits
from eap.ids import ObjectId
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.dictionary import ObjectDictionary, check_value, extract_bits
from eap.od.model import WO, Access, Entry, OdObject, OdState, ReadHook
from eap.od.profiles import eap1000 as profile
from eap.od.profiles.eap1000 import AddressMode, Configured, FrameSub, PortSub, Rx, Status, Tx, Var
from eap.od.profiles.table import (
    CONFIG,
    DEFAULT_TYPE,
    OWN_TYPE,
    ProfileEntry,
    ProfileObject,
    make_entry,
    make_object,
)
from eap.pd.authentication import SIGNED_BYTES
from eap.pd.device import DeviceFault
from eap.pd.rules import data_budget, frame_budget
from eap.pd.spec import PortSpec, StationSpec

TRANSPORTS = ("udp", "ethernet", "tcp", "loop")
"""By the number that 0xF810:02 shows."""
NAME_AT = {
    0x6: (0x6000, Var.NAME),
    0x7: (0x7000, Var.NAME),
    0x8: (0x8000, FrameSub.NAME),
    0xA: (0x8000, FrameSub.NAME),
    0xB: (0xD000, Tx.NAME),
    0xC: (0xE000, Rx.NAME),
    0xD: (0xD000, Tx.NAME),
    0xE: (0xE000, Rx.NAME),
}
"""Range and sub-index of the entry that names an object, by the high digit of its index."""
_STEMS = {0x6: "tx-variable", 0x7: "rx-variable", 0x8: "frame", 0xD: "txpd", 0xE: "rxpd"}
"""Names of new objects, without their number."""
_CHANGEABLE = {
    profile.TX_FRAME.first: FrameSub.CHANGEABLE,
    profile.TX_PD.first: Tx.CHANGEABLE,
    profile.RX_PD.first: Rx.CHANGEABLE,
}
"""Entry that allows writing in Op those entries that the profile calls changeable."""


class LiveValues(Protocol):
    """Live values of a station: its process image while the engine runs."""

    def octets(self, key: str, name: str) -> bytes | None:
        """Return the value of *key* (a live entry of the profile) for the object called *name*.

        None, or bytes of another length than the entry has, reads as zero: the engine does not run
        the object yet, or no longer.
        """

    def consistent_values(self) -> AbstractContextManager[None]:
        """Show counters of one moment for the length of a block."""


class NoLiveValues:
    """Live values of a device whose engine does not run."""

    def octets(self, key: str, name: str) -> bytes | None:
        """Return None for everything."""
        return None

    def consistent_values(self) -> AbstractContextManager[None]:
        """Do nothing."""
        return nullcontext()


class DeviceIdentity(NamedTuple):
    """Identity of a device."""

    module_profile: int = profile.MODULE_PROFILE
    device_name: str = "EAP appliance"
    hardware_version: str = ""
    software_version: str = ""
    vendor: int = 0
    product: int = 0
    revision: int = 0
    serial: int = 0

    def entries(self) -> dict[tuple[int, int], str | int]:
        """Return the entries that all profiles share: values by index and sub-index."""
        return {
            (0x1008, 0): self.device_name,
            (0x1009, 0): self.hardware_version,
            (0x100A, 0): self.software_version,
            (0x1018, 1): self.vendor,
            (0x1018, 2): self.product,
            (0x1018, 3): self.revision,
            (0x1018, 4): self.serial,
        }


class EapDictionary(ObjectDictionary):
    """Dictionary of one EAP port of a station, for clients to read and to write.

    Args:
        station: The station as it was started: its port is taken from it, nothing else is.
        port: Name of the port.
        live: Source of the values of live entries.
        identity: Values of 0x1000 to 0x1018.

    Attributes:
        on_request: Called with the number of the state that a client writes to 0xF200:01.
        on_download: Called with index, sub-index, bytes, and whether the access was complete, after
            a client wrote configuration in PreOp.
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
        super().__init__()
        self.station = station
        self.port: PortSpec = next(each for each in station.ports if each.name == port)
        self.uri = self.port.interface
        self.live: LiveValues = live or NoLiveValues()
        self.identity = identity
        self.on_request: Callable[[int], object] | None = None
        self.on_download: Callable[[int, int, bytes, bool], object] | None = None
        self.on_change: Callable[[int, int], None] | None = None
        self._net_id = self.port.net_id
        self._members: dict[int, dict[int, OdObject]] = {row.first: {} for row in profile.ALL}
        for row in profile.STATIC:
            self.add(self.make_object(row, row.first))
        self._set_fixed()

    def _set_fixed(self) -> None:
        identity, uri = self.identity, self.uri
        fixed = {
            (0x1000, 0): identity.module_profile << 16 | (self.port.profile or profile.PROFILE),
            **identity.entries(),
            (profile.PORT, PortSub.NAME): self.port.name,
            (profile.PORT, PortSub.TRANSPORT): TRANSPORTS.index(uri.scheme),
            (profile.PORT, PortSub.INTERFACE): str(uri),
            (profile.PORT, PortSub.PORT_NUMBER): uri.port,
            (profile.NET_ID, 1): self._net_id,
        }
        for (index, subindex), value in fixed.items():
            self[index].entries[subindex].value = value

    def add(self, item: OdObject) -> None:
        """Add an object of the profile."""
        row = profile.find(item.index)
        if row is None:
            raise SdoAbortError(AbortCode.NO_OBJECT, item.index, 0, "the profile has none there")
        super().add(item)
        self._members[row.first][item.index] = item

    def remove(self, index: int) -> None:
        """Remove an object, and its companion with the live values."""
        super().remove(index)
        row = profile.find(index)
        if row is not None:
            self._members[row.first].pop(index, None)
            if row.companion:
                self.remove(index - row.first + row.companion)

    def members(self, *rows: ProfileObject) -> list[int]:
        """Return the indexes of the objects that *rows* describe, in order."""
        return [index for row in rows for index in sorted(self._members[row.first])]

    def make(self, row: ProfileObject, index: int) -> OdObject:
        """Add an object of a dynamic range, and its companion with the live values."""
        item = self.make_object(row, index)
        self.add(item)
        number = index - row.first
        companion = profile.find(row.companion) if row.companion else None
        if companion is not None:
            self.add(self.make_object(companion, companion.first + number))
        if not row.mapping:
            item.entries[NAME_AT[index >> 12][1]].value = f"{_STEMS[index >> 12]}{number}"
        if row is profile.TX_PD:
            # Read only: the publisher ID of a PD is the NetID of the port that sends it.
            item.entries[Tx.PUBLISHER].octets = self._net_id
        return item

    def make_object(
        self, row: ProfileObject, index: int, kind: DataType = DEFAULT_TYPE, last: int = 0
    ) -> OdObject:
        """Return an object with its defaults, not added yet; arguments as for ``make_object``."""
        return make_object(row, index, partial(self._source, index), kind=kind, last=last)

    def _source(
        self, index: int, row: ProfileEntry, subindex: int, kind: DataType
    ) -> ReadHook | None:
        if row.live:
            return partial(self._live, index, row.live, kind.size)
        return partial(self._derived, index, subindex) if row.derived else None

    def grow(self, index: int, last: int) -> None:
        """Add entries up to *last* to the list of the object at *index*, without counting them."""
        item, row = self[index], profile.row_of(index)
        list_row, source = row.list_row, partial(self._source, index)
        if list_row is not None:
            # A mapping may be written entry by entry while sub-index 0 is still 0, as in slaves.
            for subindex in range(max(max(item.entries) + 1, list_row.subindex), last + 1):
                item.entries[subindex] = make_entry(list_row, subindex, source)

    def resize(self, index: int, count: int) -> None:
        """Add or remove entries of the object at *index* so that sub-index 0 is *count*."""
        item = self[index]
        self.grow(index, count)
        for subindex in [sub for sub in item.entries if sub > count]:
            del item.entries[subindex]
        item.entries[0].value = count

    def put(self, index: int, subindex: int, octets: bytes) -> None:
        """Store the bytes of an entry, and update the types and access rights that depend on it."""
        item, row = self[index], profile.row_of(index)
        if row in profile.VARIABLES and subindex == Var.TYPE_NAME:
            self._retype(item, row, datatypes.parse(octets.decode()))
        item.entries[subindex].octets = octets
        if subindex == _CHANGEABLE.get(row.first):
            for each in row.entries:
                if each.changeable:
                    more = WO if any(octets) else each.access
                    item.entries[each.subindex].access = each.access | more

    def _retype(self, item: OdObject, row: ProfileObject, kind: DataType) -> None:
        """Change the type of a variable; its default is reset."""
        if item.entries[Var.DEFAULT].kind == kind:
            return
        source = partial(self._source, item.index)
        for each in row.entries:
            if each.kind == OWN_TYPE:
                item.entries[each.subindex] = make_entry(each, each.subindex, source, kind=kind)
        item.entries[Var.DEFAULT_GIVEN].value = False

    def name_of(self, index: int) -> str:
        """Return the name of the subject of the object at *index*, empty for the device itself."""
        where = NAME_AT.get(index >> 12)
        if where is None:
            return ""
        return self._objects[where[0] | index & 0xFFF].entries[where[1]].octets.decode()

    def pdo_length(self, pd_index: int) -> int:
        """Return the size of the data of a PD in bytes; 0 as long as it has no complete PDO."""
        mapping = self._objects.get(self[pd_index].entries[Tx.PDO_INDEX].value)
        return 0 if mapping is None else -(-mapped_bits(self, mapping) // 8)

    def frame_length(self, index: int) -> int:
        """Return the size of the frame at *index* in bytes, with all existing PDs that it lists."""
        listed = [pd for _, pd in self.listed_pds(index) if pd in self]
        signature = SIGNED_BYTES if self[index].entries[FrameSub.SIGN].value else 0
        return FIRST_PD + sum(PdHeader.SIZE + self.pdo_length(pd) for pd in listed) + signature

    def listed_pds(self, index: int) -> Iterator[tuple[int, int]]:
        """Yield sub-index and TxPD of the list of the frame at *index*, without its blanks."""
        for subindex, entry in self[index].entries.items():
            if subindex >= FrameSub.TXPD and (pd := int.from_bytes(entry.octets, "little")):
                yield subindex, pd

    def next_free(self, rows: tuple[ProfileObject, ...]) -> int:
        """Return the first index of *rows* that is free, 0 if none is."""
        for row in rows:
            taken = self._members[row.first]
            for index in range(row.first, row.last + 1):
                if index not in taken:
                    return index
        return 0

    def reference_to(self, index: int) -> tuple[int, int] | None:
        """Return the entry (object, sub-index) that refers to the object at *index*, if any."""
        row = profile.row_of(index)
        if row in profile.VARIABLES:
            return next(self._mappings_of(index), None)
        if row is profile.TX_PD:
            for frame in self._members[profile.TX_FRAME.first]:
                for subindex, pd in self.listed_pds(frame):
                    if pd == index:
                        return frame, subindex
            return self._poll_of(index, profile.RX_PD, Rx.POLL_REQUEST_TXPD)
        if row is profile.RX_PD:
            return self._poll_of(index, profile.TX_PD, Tx.POLL_REQUEST_RXPD)
        return None

    def _mappings_of(self, index: int) -> Iterator[tuple[int, int]]:
        for row in profile.MAPPINGS:
            for item in self._members[row.first].values():
                for subindex, entry in item.entries.items():
                    if subindex and MappingEntry.decode(entry.value).target == index:
                        yield item.index, subindex

    def _poll_of(self, index: int, row: ProfileObject, subindex: int) -> tuple[int, int] | None:
        for item in self._members[row.first].values():
            if item.entries[subindex].value == index:
                return item.index, subindex
        return None

    def consistent_values(self) -> AbstractContextManager[None]:
        """Show live counters of one moment for the length of a block."""
        return self.live.consistent_values()

    def _live(self, index: int, key: str, size: int) -> bytes:
        """Return the live value of *key* for the subject of an object; zero without one."""
        octets = self.live.octets(key, self.name_of(index))
        return octets if octets is not None and len(octets) == size else bytes(size)

    def _derived(self, index: int, subindex: int) -> bytes:
        """Return a length, a count, a type or a free index."""
        entry = self[index].entries[subindex]
        return entry.kind.encode(self._compute(profile.row_of(index), index, subindex))

    def _compute(self, row: ProfileObject, index: int, subindex: int) -> int:
        if row is profile.TX_FRAME:
            return self.frame_length(index)
        if row in {profile.TX_PD, profile.RX_PD}:
            return self.pdo_length(index)
        if index in {profile.OBJECT_COUNTS, profile.FREE_INDEXES}:
            rows = profile.COUNTED[subindex - Configured.TXFRAMES]
            is_count = index == profile.OBJECT_COUNTS
            return len(self.members(*rows)) if is_count else self.next_free(rows)
        kind = self[index].entries[Var.DEFAULT].kind
        return kind.bit_length if subindex == Var.BIT_LENGTH else kind.code

    def blank(self) -> EapDictionary:
        """Return an empty dictionary of the same port, without live values."""
        return EapDictionary(self.station, self.port.name, identity=self.identity)

    def show_status(self, word: int, fault: DeviceFault | None) -> None:
        """Show the state of the device, and the fault that keeps it there, in 0xF100."""
        entries = self[profile.STATUS].entries
        entries[Status.STATE].value = word
        entries[Status.ERROR_CODE].value = fault.code if fault else 0
        text = fault.text if fault else ""
        entries[Status.ERROR_TEXT].octets = text.encode()[: entries[Status.ERROR_TEXT].kind.size]
        object_id = fault.index << 16 | fault.subindex << 8 if fault else 0
        entries[Status.ERROR_OBJECT].value = object_id

    def download(self, index: int, subindex: int, data: bytes, state: OdState) -> None:
        """Write one entry; creates and deletes dynamic objects."""
        with self._all_or_nothing(index):
            is_new = self._create_missing(index, subindex, state)
            row = profile.row_of(index)
            # Deleting what does not exist must not make it first.
            if is_new and subindex == 0 and data == b"\0" and not row.mapping:
                raise SdoAbortError(AbortCode.NO_OBJECT, index, 0)
            self._write(row, index, subindex, data, state)
            self._finish_download(row, index, [subindex], state)
        self._note_download(index, subindex, data, state, complete=False)

    def download_complete(self, index: int, first: int, data: bytes, state: OdState) -> None:
        """Write a whole object by complete access; sub-index 0 sets the length of a list."""
        with self._all_or_nothing(index):
            self._create_missing(index, first, state)
            row = profile.row_of(index)
            self._write_whole(row, index, first, data, state)
            self._finish_download(
                row, index, list(self[index].entries) if index in self else [], state
            )
        self._note_download(index, first, data, state, complete=True)

    def _note_download(
        self, index: int, subindex: int, data: bytes, state: OdState, *, complete: bool
    ) -> None:
        if state is OdState.PREOP and index != profile.CONTROL and self.on_download is not None:
            self.on_download(index, subindex, data, complete)

    def check_download(
        self, index: int, subindex: int, size: int, state: OdState, *, complete: bool = False
    ) -> None:
        """Abort a download that is invalid before its data has arrived."""
        row = profile.find(index)
        if row is None or not (row.dynamic or (row.list_row and index in self)):
            super().check_download(index, subindex, size, state, complete=complete)
            return
        self._check_making(index, subindex, state)
        is_there = index in self and row in profile.VARIABLES
        kind = self[index].entries[Var.DEFAULT].kind if is_there else DEFAULT_TYPE
        # At full length, because the data that sets the length has not arrived yet.
        largest = self.make_object(row, index, kind, row.last_subindex)
        for number, entry in self._objects.get(index, largest).entries.items():
            largest.entries[number].access = entry.access
        ObjectDictionary([largest]).check_download(index, subindex, size, state, complete=complete)

    @contextmanager
    def _all_or_nothing(self, index: int) -> Iterator[None]:
        # Only this object is saved: a download changes no other one before its checks pass.
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

    def _create_missing(self, index: int, subindex: int, state: OdState) -> bool:
        """Create the object at *index* if it is dynamic and does not exist."""
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
            # In complete access sub-index 0 takes 16 bits; the upper byte is padding.
            if len(data) < 2:
                raise SdoAbortError(AbortCode.TOO_SHORT, index, 0, "sub-index 0 has two bytes")
            count, data = data[0] if has_count else count, data[2:]
        if has_count:
            if count == 0 and data:
                raise SdoAbortError(AbortCode.TOO_LONG, index, 0, "nothing follows a 0")
            self._resize(row, item, count, state)
            if index not in self:
                return
        chosen = [(sub, each) for sub, each in item.entries.items() if 1 <= sub <= count]
        for subindex, octets in _part(index, chosen, data, state):
            self._write(row, index, subindex, octets, state)
        if has_count and row.mapping:
            self._write_count(row, item, bytes((count,)), state)

    def _resize(self, row: ProfileObject, item: OdObject, count: int, state: OdState) -> None:
        """Empty a mapping and add *count* entries, or resize a list; 0 may delete the object."""
        if row.mapping:
            # A mapping has to be empty before its entries can be written, also within one access.
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
        super().check_download(index, subindex, len(data), state)
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
        super().check_download(index, 0, len(data), state)
        count = data[0]
        if row.mapping:
            if count > max(item.entries):
                detail = f"{max(item.entries)} entries are written"
                raise SdoAbortError(AbortCode.NO_SUBINDEX, index, count, detail)
            for subindex in range(1, count + 1):
                check_mapped(
                    self, item.entries[subindex].value, _mapping_right(row), index, subindex
                )
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
        # A mapping in force is changed only after sub-index 0 was set to 0, as in slaves.
        if item.max_subindex:
            raise SdoAbortError(AbortCode.SUBINDEX_0_NOT_ZERO, item.index, subindex)
        word = int.from_bytes(data, "little")
        check_mapped(self, word, _mapping_right(row), item.index, subindex)

    def _check_unused(self, index: int, subindex: int) -> None:
        user = self.reference_to(index)
        if user is not None:
            is_mapped = profile.row_of(index) in profile.VARIABLES
            code = AbortCode.MAPPED if is_mapped else AbortCode.PARAMETER
            detail = f"{ObjectId(*user)} refers to it"
            raise SdoAbortError(code, index, subindex, detail)

    def _finish_download(
        self, row: ProfileObject, index: int, written: list[int], state: OdState
    ) -> None:
        """Check the budgets of the frames that written entries affect, and call the callbacks."""
        if index not in self:
            return
        frames = {
            frame: subindex
            # Reversed, so that the first entry that concerns a frame is the one that an abort
            # names.
            for subindex in reversed(written)
            for frame in self._frames_to_check(row, index, subindex)
        }
        for frame, subindex in frames.items():
            self._check_budget(frame, index, subindex)
        if index == profile.CONTROL:
            if self.on_request is not None:
                self.on_request(self[index].entries[1].value)
        # In PreOp nothing runs: the check of SafeOp reads all entries at once.
        elif state is not OdState.PREOP and self.on_change is not None:
            try:
                self.on_change(index, written[0])
            except DeviceFault as exc:
                raise SdoAbortError(AbortCode.PARAMETER, index, written[0], str(exc)) from None

    def _frames_to_check(self, row: ProfileObject, index: int, subindex: int) -> list[int]:
        """Return the frames whose length or budget depends on the entry."""
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
            name = self.name_of(frame)
            detail = f"{name} would have {length} bytes, at most {budget} fit its destination"
            raise SdoAbortError(AbortCode.PDO_LENGTH, index, subindex, detail)


def is_counted(item: OdObject) -> bool:
    """Return whether sub-index 0 of *item* can be written."""
    return item.entries[0].access == CONFIG


def _mapping_right(row: ProfileObject) -> Access:
    is_sent = row in {profile.TX_PDO, profile.MORE_TX_PDO}
    return Access.TX_MAPPABLE if is_sent else Access.RX_MAPPABLE


def _part(
    index: int, chosen: list[tuple[int, Entry]], data: bytes, state: OdState
) -> Iterator[tuple[int, bytes]]:
    """Yield the bytes of each writable entry of *chosen* from the data of a complete access."""
    plan = datatypes.layout([entry.kind for _, entry in chosen])
    if len(data) != plan.size:
        code = AbortCode.TOO_SHORT if len(data) < plan.size else AbortCode.TOO_LONG
        raise SdoAbortError(code, index, 1, f"{len(data)} bytes for entries of {plan.size}")
    if chosen and not any(entry.access & state.write_right for _, entry in chosen):
        writable = any(entry.access & Access.WRITE_ANY for _, entry in chosen)
        code = AbortCode.DEVICE_STATE if writable else AbortCode.READ_ONLY
        raise SdoAbortError(code, index, 1)
    for (subindex, entry), offset in zip(chosen, plan.bit_offsets, strict=True):
        # Read-only entries take their place in the data and are skipped, so that a client can send
        # back what it has read.
        if entry.access & state.write_right:
            yield subindex, extract_bits(data, offset, entry.kind)
