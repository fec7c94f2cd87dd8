"""What an EAP port is and does, as objects: who refers to whom, and what is computed from it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager
from typing import NamedTuple

from eap.codec.pd import FIRST_PD, PdHeader
from eap.device.eap_mapping import Mapped, mapped_bits
from eap.device.eap_objects import NAME_AT, EapObjects, Views
from eap.device.live import LiveValues, NothingRuns
from eap.ids import InterfaceUri, NetId
from eap.od.profiles import eap1000 as profile
from eap.od.profiles.eap1000keys import Configured, Frame, Port, Rx, Tx, Var
from eap.od.profiles.table import ObjectRange
from eap.pd.spec import PortKind, PortSpec, StationSpec

STATUS = 0xF100
COUNTED = 0xF800
FREE = 0xF801
PORT = 0xF810
NET_ID = 0xF920
TRANSPORTS = ("udp", "ethernet", "tcp", "loop")
"""By the number that 0xF810:02 shows."""


class Identity(NamedTuple):
    """What a device says of itself."""

    module_profile: int = profile.MODULE_PROFILE
    device_name: str = "EAP appliance"
    hardware_version: str = ""
    software_version: str = ""
    vendor: int = 0
    product: int = 0
    revision: int = 0
    serial: int = 0

    def entries(self) -> dict[tuple[int, int], str | int]:
        """Return what devices of any profile show: values by index and subindex."""
        return {
            (0x1008, 0): self.device_name,
            (0x1009, 0): self.hardware_version,
            (0x100A, 0): self.software_version,
            (0x1018, 1): self.vendor,
            (0x1018, 2): self.product,
            (0x1018, 3): self.revision,
            (0x1018, 4): self.serial,
        }


class EapContent(EapObjects):
    """What one EAP port of a station is and does, as objects.

    Args:
        station: The station as it was started: its port is taken from it, nothing else is.
        port: Name of the port.
        live: Where live entries get their values.
        identity: What 0x1000 to 0x1018 show.
    """

    def __init__(
        self,
        station: StationSpec,
        port: str,
        live: LiveValues | None = None,
        identity: Identity = Identity(),  # noqa: B008  immutable
    ) -> None:
        self.port: PortSpec = next(each for each in station.ports if each.name == port)
        super().__init__(NetId.parse(self.port.net_id), Views(self._live, self._derived))
        self.uri = InterfaceUri.parse(self.port.interface)
        self.live: LiveValues = live or NothingRuns()
        self.identity = identity
        self._set_fixed()

    def _set_fixed(self) -> None:
        who, uri = self.identity, self.uri
        fixed = {
            (0x1000, 0): who.module_profile << 16 | (self.port.profile or profile.PROFILE),
            **who.entries(),
            (PORT, Port.NAME): self.port.name,
            (PORT, Port.TRANSPORT): TRANSPORTS.index(uri.scheme),
            (PORT, Port.INTERFACE): self.port.interface,
            (PORT, Port.PORT_NUMBER): uri.port,
            (NET_ID, 1): NetId.parse(self.port.net_id),
        }
        for (index, subindex), value in fixed.items():
            self[index].entries[subindex].value = value

    def name_of(self, index: int) -> str:
        """Return the name of what the object at *index* is about, empty for the device itself."""
        where = NAME_AT.get(index >> 12)
        if where is None:
            return ""
        return self._objects[where[0] | index & 0xFFF].entries[where[1]].octets.decode()

    def pdo_length(self, pd_index: int) -> int:
        """Return the octets of data of a PD; 0 as long as it has no whole PDO."""
        mapping = self._objects.get(self[pd_index].entries[Tx.PDO_INDEX].value)
        return 0 if mapping is None else -(-mapped_bits(self, mapping) // 8)

    def frame_length(self, index: int) -> int:
        """Return the octets of the frame at *index* with all PDs that it lists and that exist."""
        listed = [pd for _, pd in self.listed_pds(index) if pd in self]
        return FIRST_PD + sum(PdHeader.SIZE + self.pdo_length(pd) for pd in listed)

    def listed_pds(self, index: int) -> Iterator[tuple[int, int]]:
        """Yield sub-index and TxPD of the list of the frame at *index*, without its blanks."""
        for subindex, entry in self[index].entries.items():
            if subindex >= Frame.TXPD and (pd := int.from_bytes(entry.octets, "little")):
                yield subindex, pd

    def next_free(self, rows: tuple[ObjectRange, ...]) -> int:
        """Return the first index of *rows* that is free, 0 if none is."""
        for row in rows:
            taken = self._members[row.first]
            for index in range(row.first, row.last + 1):
                if index not in taken:
                    return index
        return 0

    def user_of(self, index: int) -> tuple[int, int] | None:
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
                    if subindex and Mapped.decode(entry.value).target == index:
                        yield item.index, subindex

    def _poll_of(self, index: int, row: ObjectRange, subindex: int) -> tuple[int, int] | None:
        for item in self._members[row.first].values():
            if item.entries[subindex].value == index:
                return item.index, subindex
        return None

    def at_one_moment(self) -> AbstractContextManager[None]:
        """Show live counters of one moment for the length of a block."""
        return self.live.at_one_moment()

    def _live(self, index: int, key: str, size: int) -> bytes:
        """Return what *key* shows of what the object is about; zero if that does not run."""
        octets = self.live.octets(key, self.name_of(index))
        return octets if octets is not None and len(octets) == size else bytes(size)

    def _derived(self, index: int, subindex: int) -> bytes:
        """Return a length, a count, a type or a free index."""
        entry = self[index].entries[subindex]
        return entry.kind.encode(self._compute(profile.row_of(index), index, subindex))

    def _compute(self, row: ObjectRange, index: int, subindex: int) -> int:
        if row is profile.TX_FRAME:
            return self.frame_length(index)
        if row in {profile.TX_PD, profile.RX_PD}:
            return self.pdo_length(index)
        if index in {COUNTED, FREE}:
            rows = profile.COUNTED[subindex - Configured.TXFRAMES]
            return self.next_free(rows) if index == FREE else len(self.members(*rows))
        kind = self[index].entries[Var.DEFAULT].kind
        return kind.bit_length if subindex == Var.BIT_LENGTH else kind.code


def bus_variables(station: StationSpec) -> set[str]:
    """Return the names of the variables that *station* has because of its buses.

    They are not configured here; a Tx variable of the same name is one of them.
    """
    prefixes = tuple(f"{port.name}." for port in station.ports if port.kind is PortKind.BUS)
    return {each.name for each in station.variables if each.name.startswith(prefixes)}
