"""PDs of a publisher by its own dictionary (sub-profile 1000), with names and types.

Asked by ADS over the routes of a running appliance.  Objects and the sub-indexes 3 and 4 of a TxPD
are those of the profile; names, triggers and type names are found where this product has them
(``eap.od.profiles.eap1000``), since no public document tells where other vendors do.  Without them
the description of a mapped entry gives its name and type.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from eap.codec import datatypes
from eap.codec.datatypes import DataType
from eap.codec.ethercat import EAP_PORT
from eap.errors import ControlError
from eap.ids import MacAddr, NetId
from eap.od.abort import SdoAbortError
from eap.od.profiles.eap1000 import MAX_ENTRIES, WHOLE, AddressMode, FrameSub, Tx, Var
from eap.ops.od import OdDevice
from eap.ops.od_devices import Target, open_device

_TX_PDS = range(0xD000, 0xE000)
_TX_PDOS = (*range(0x1A00, 0x1C00), *range(0x3000, 0x3E00))
_FRAMES = range(0x8000, 0x9000)
_MOST_NAMES = 64
"""Characters of a name that are kept."""
_UNFIT = re.compile(r"[\s/\x00-\x1f\x7f]+")
"""Characters that no name of a plant file has."""


class PublishedVariable(NamedTuple):
    """One variable of a PD; gaps of its layout are variables called ``gap1`` and so on."""

    name: str
    type: str


class PublishedPd(NamedTuple):
    """One TxPD of a publisher.

    *transport* and *destination* are as in a discovered PD, both empty where they are not known;
    *cycle_us* is 0 without a cycle time.
    """

    publisher: str
    pd_id: int
    version: int
    length: int
    name: str
    variables: tuple[PublishedVariable, ...]
    cycle_us: int = 0
    transport: str = ""
    destination: str = ""


def ask_publisher(net_id: str) -> list[PublishedPd]:
    """Return the PDs that the EAP device with *net_id* has in its dictionary.

    Raises:
        ControlError: no appliance runs or has a route there, the device does not answer, or its
            dictionary has no PDs.
    """
    with open_device(Target.parse(net_id)) as device:
        found = list(published_pds(device, net_id))
    if not found:
        raise ControlError(f"{net_id}: its dictionary has no PDs to send (objects 0xD000 and up)")
    return found


def published_pds(device: OdDevice, net_id: str) -> Iterator[PublishedPd]:
    """Yield the PDs of the dictionary of *device*; parts that cannot be read are left out."""
    reader = _PublisherReader(device)
    indexes = [each.index for each in device.objects()]
    destinations = _destinations(reader, [each for each in indexes if each in _FRAMES])
    for index in indexes:
        if index not in _TX_PDS:
            continue
        pd_id, version = reader.number(index, Tx.PD_ID), reader.number(index, Tx.VERSION)
        pdo = reader.number(index, Tx.PDO_INDEX)
        if pd_id is None:
            continue
        # Without a usable number, the PDO of the same position is the likely one.
        if pdo is None or pdo not in _TX_PDOS:
            pdo = _TX_PDOS[0] + index - _TX_PDS.start
        variables = reader.variables(pdo)
        if variables is None:
            continue
        yield PublishedPd(
            net_id,
            pd_id,
            version or 0,
            datatypes.layout([kind for _, kind in variables]).size,
            _name(reader.text(index, Tx.NAME)) or f"pd{pd_id}",
            tuple(_unique(variables)),
            reader.number(index, Tx.CYCLE_TIME) or 0,
            *destinations.get(index, ("", "")),
        )


class _PublisherReader:
    """Reader of entries that need not be there; each variable is read once."""

    def __init__(self, device: OdDevice) -> None:
        self._device = device
        self._known: dict[tuple[int, int], tuple[str, DataType] | None] = {}

    def octets(self, index: int, subindex: int) -> bytes | None:
        """Return the bytes of an entry, None if the device refuses."""
        try:
            return self._device.read(index, subindex)
        except (ControlError, SdoAbortError):
            return None

    def number(self, index: int, subindex: int) -> int | None:
        octets = self.octets(index, subindex)
        return int.from_bytes(octets, "little") if octets and len(octets) <= 4 else None

    def text(self, index: int, subindex: int) -> str:
        octets = self.octets(index, subindex) or b""
        return octets.split(b"\0")[0].decode("utf-8", "replace")

    def variables(self, pdo: int) -> list[tuple[str, DataType]] | None:
        """Return names and types of a PDO in their order, gaps included; None if unknown."""
        count = self.number(pdo, 0)
        if not count:
            return None
        found: list[tuple[str, DataType]] = []
        begin = end = gaps = 0
        # A device may claim any count.
        for subindex in range(1, min(count, MAX_ENTRIES) + 1):
            mapping = self.number(pdo, subindex)
            if mapping is None:
                return None
            index, entry, bits = mapping >> 16, mapping >> 8 & 0xFF, mapping & 0xFF
            if not index:
                begin += bits
                continue
            variable = self._variable(index, entry)
            if variable is None or bits not in {WHOLE, variable[1].bit_length}:
                return None
            # Where a variable follows the one before without a gap, the padding entries are those
            # that every layout has; others are gaps.
            if datatypes.layout([*_kinds(found), variable[1]]).bit_offsets[-1] != begin:
                for kind in _gap(end, begin):
                    gaps += 1
                    found.append((f"gap{gaps}", kind))
            found.append(variable)
            if datatypes.layout(_kinds(found)).bit_offsets[-1] != begin:
                return None  # overlapping, or a bit that starts where none of ours can
            begin = end = begin + variable[1].bit_length
        for kind in _gap(end, begin) if begin - end > 7 else ():
            gaps += 1
            found.append((f"gap{gaps}", kind))
        return found

    def _variable(self, index: int, subindex: int) -> tuple[str, DataType] | None:
        key = index, subindex
        if key not in self._known:
            self._known[key] = self._read_variable(index, subindex)
        return self._known[key]

    def _read_variable(self, index: int, subindex: int) -> tuple[str, DataType] | None:
        try:
            entry = self._device.entry(index, subindex)
        except (ControlError, SdoAbortError):
            entry = None
        kind = None if entry is None else entry.kind
        name = self.text(index, Var.NAME) if subindex == Var.VALUE else ""
        type_name = self.text(index, Var.TYPE_NAME) if name else ""
        if type_name:
            try:
                kind = datatypes.parse(type_name)
            except ValueError:
                name = ""  # the sub-indexes of this device have another meaning
        if kind is None:
            return None
        return _name(name or (entry.name if entry else "")) or f"x{index:04x}_{subindex}", kind


def _kinds(variables: Iterable[tuple[str, DataType]]) -> list[DataType]:
    return [kind for _, kind in variables]


def _gap(begin: int, end: int) -> Iterator[DataType]:
    """Yield types that fill the bits from *begin* to *end*."""
    while begin < end and begin % 8:
        bits = min(8 - begin % 8, end - begin)
        yield datatypes.parse(f"BIT{bits}")
        begin += bits
    if octets := (end - begin) // 8:
        yield datatypes.parse(f"BLOCK({octets})")
    if rest := (end - begin) % 8:
        yield datatypes.parse(f"BIT{rest}")


def _destinations(reader: _PublisherReader, frames: Sequence[int]) -> dict[int, tuple[str, str]]:
    """Return transport and destination of each TxPD that one of *frames* carries."""
    found = {}
    for frame in frames:
        destination = _destination(reader, frame)
        count = reader.number(frame, 0) or 0
        for subindex in range(FrameSub.TXPD, min(count, MAX_ENTRIES) + 1):
            index = reader.number(frame, subindex)
            if index:
                found[index] = destination
    return found


_BY_IP = {AddressMode.IP: "udp", AddressMode.TCP: "tcp"}


def _destination(reader: _PublisherReader, frame: int) -> tuple[str, str]:
    """Return transport and destination of a frame; of a NetID the MAC address is not known."""
    mode = reader.number(frame, FrameSub.ADDRESS_MODE)
    octets = b""
    if mode == AddressMode.MAC:
        octets = reader.octets(frame, FrameSub.DESTINATION_MAC) or b""
        return ("ethernet", str(MacAddr(octets))) if len(octets) == 6 else ("", "")
    if mode == AddressMode.NET_ID:
        octets = reader.octets(frame, FrameSub.DESTINATION_NETID) or b""
        return "", str(NetId(octets)) if len(octets) == 6 else ""
    transport = _BY_IP.get(AddressMode(mode)) if mode in set(AddressMode) else None
    octets = reader.octets(frame, FrameSub.DESTINATION_IP) or b""
    if transport is None or len(octets) != 4:
        return "", ""
    port = reader.number(frame, FrameSub.PORT_NUMBER) or EAP_PORT
    suffix = "" if port == EAP_PORT else f":{port}"
    return transport, ".".join(map(str, octets)) + suffix


def _name(text: str) -> str:
    return _UNFIT.sub("_", text.strip())[:_MOST_NAMES]


def _unique(variables: Iterable[tuple[str, DataType]]) -> Iterator[PublishedVariable]:
    """Yield variables, each with a name of its own."""
    used: set[str] = set()
    for name, kind in variables:
        own, number = name, 1
        while own in used:
            number += 1
            own = f"{name}_{number}"
        used.add(own)
        yield PublishedVariable(own, kind.text)
