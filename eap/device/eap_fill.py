"""From a station's specification to the objects of one of its EAP ports.

Variables that the station has for itself are objects of its first EAP port; another port has those
that it sends.  What is received is an object of the port that it comes to.

Fields that are one entry each are converted as the table of the profile says; the functions here
make what takes several objects or entries: references, mappings, lists and addresses.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from ipaddress import IPv4Address
from types import MappingProxyType
from typing import Any

from msgspec import Struct

from eap.codec import datatypes
from eap.device.eap_dictionary import EapDictionary
from eap.device.eap_rules import encode_mapping
from eap.device.pdlayout import bus_variables
from eap.ids import Destination, DestinationKind, MacAddr, NetId
from eap.od.profiles import eap1000 as profile
from eap.od.profiles.eap1000 import AddressMode, FrameSub, Rx, RxFlag, Tx, Var
from eap.od.profiles.table import ProfileObject
from eap.pd.device import DeviceFault, FaultCode
from eap.pd.spec import (
    REQUESTER,
    OnChangeSpec,
    PortKind,
    RxPdSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
)

_NO_CHANGE = OnChangeSpec()


def fill(dictionary: EapDictionary, like: EapDictionary | None = None) -> None:
    """Make objects of what the station of *dictionary* says of its port.

    Args:
        dictionary: An empty one.
        like: Another one of the same port; what has the same name there gets the same index.

    Raises:
        DeviceFault: the port has more than there are objects for, or a PD more variables than a
            mapping has entries, or a text is too long for its entry.
    """
    _Filling(dictionary, like).run()


class _Filling:
    def __init__(self, dictionary: EapDictionary, like: EapDictionary | None) -> None:
        self._dictionary = dictionary
        self._like = like
        station, port = dictionary.station, dictionary.port.name
        self._station = station
        self._frames = [frame for frame in station.frames if frame.port == port]
        self._tx = [pd for frame in self._frames for pd in frame.pds]
        self._rx = [pd for pd in station.subscriptions if pd.port == port]
        named = {variable.name: variable for variable in station.variables}
        received = {name for pd in self._rx for name in pd.variables}
        self._tx_variables = [named[name] for name in self._sent(received)]
        self._rx_variables = [v for v in station.variables if v.name in received]
        self._types = {name: datatypes.parse(each.type) for name, each in named.items()}
        self._objects: dict[str, int] = {}
        """Index of each variable, by name."""

    def _sent(self, received: set[str]) -> list[str]:
        """Return the names of the variables that are to be Tx variables, in their order."""
        station = self._station
        wanted = {name for pd in self._tx for name in pd.variables}
        first = next(port for port in station.ports if port.kind is PortKind.EAP)
        if first.name == self._dictionary.port.name:
            others = {name for pd in station.subscriptions for name in pd.variables}
            others |= bus_variables(station)
            wanted |= {each.name for each in station.variables} - others
        wanted -= received
        return [each.name for each in station.variables if each.name in wanted]

    def run(self) -> None:
        """Make all objects."""
        self._fill_device()
        for row, variables in (
            (profile.TX_VARIABLE, self._tx_variables),
            (profile.RX_VARIABLE, self._rx_variables),
        ):
            places = self._assign((row,), [each.name for each in variables])
            self._objects |= places
            for variable in variables:
                self._fill_variable(row, places[variable.name], variable)
        tx = self._assign((profile.TX_PD,), [pd.name for pd in self._tx])
        rx = self._assign((profile.RX_PD,), [pd.name for pd in self._rx])
        tx_pdos = self._mappings((profile.TX_PDO, profile.MORE_TX_PDO), tx)
        rx_pdos = self._mappings((profile.RX_PDO, profile.MORE_RX_PDO), rx)
        for sent in self._tx:
            self._fill_mapping(tx_pdos[sent.name], sent)
            self._fill_tx(tx[sent.name], tx_pdos[sent.name], sent, rx)
        for received in self._rx:
            self._fill_mapping(rx_pdos[received.name], received)
            self._fill_rx(rx[received.name], rx_pdos[received.name], received, tx)
        frames = self._assign((profile.TX_FRAME,), [frame.name for frame in self._frames])
        for frame in self._frames:
            self._fill_frame(frames[frame.name], frame, tx)

    def _assign(self, rows: tuple[ProfileObject, ...], names: list[str]) -> dict[str, int]:
        """Return an index of *rows* for each name: that of *like*, or another."""
        like = self._like
        before = {like.name_of(i): i for i in like.members(*rows)} if like is not None else {}
        return self._choose(rows, names, before)

    def _mappings(self, rows: tuple[ProfileObject, ...], pds: Mapping[str, int]) -> dict[str, int]:
        """Return the index of each PD's mapping: that of *like*, or its own number."""
        before: dict[str, int] = {}
        if self._like is not None:
            members = set(self._like.members(*rows))
            for name, index in pds.items():
                if index in self._like and self._like.name_of(index) == name:
                    mapping = self._like[index].entries[Tx.PDO_INDEX].value
                    if mapping in members and mapping not in before.values():
                        before[name] = mapping
        return self._choose(rows, list(pds), before)

    def _choose(
        self, rows: tuple[ProfileObject, ...], names: list[str], before: Mapping[str, int]
    ) -> dict[str, int]:
        chosen = {name: before[name] for name in names if name in before}
        taken = set(chosen.values())
        free = (i for row in rows for i in range(row.first, row.last + 1) if i not in taken)
        for name in names:
            if name not in chosen:
                index = next(free, None)
                if index is None:
                    room = sum(row.last - row.first + 1 for row in rows)
                    detail = f"{len(names)} objects, there is room for {room}"
                    raise DeviceFault(FaultCode.NO_ROOM, detail, rows[0].first)
                chosen[name] = index
        return chosen

    def _fill_device(self) -> None:
        self._set_fields(profile.OBJECT_COUNTS, self._station)
        self._set_fields(profile.PORT, self._dictionary.port)
        self._set_list(profile.GROUPS, 1, self._dictionary.port.join)

    def _fill_variable(self, row: ProfileObject, index: int, variable: VariableSpec) -> None:
        kind = self._types[variable.name]
        self._dictionary.make(row, index)
        self._set_fields(index, variable)
        if kind.text != variable.type:
            self._set(index, {Var.TYPE_NAME: kind.text})
        if variable.default is not None:
            default = kind.from_plain(variable.default)
            self._set(index, {Var.DEFAULT_GIVEN: True, Var.DEFAULT: default})

    def _fill_mapping(self, index: int, pd: TxPdSpec | RxPdSpec) -> None:
        mapped = [(self._objects[name], self._types[name]) for name in pd.variables]
        self._dictionary.make(profile.row_of(index), index)
        try:
            words = encode_mapping(mapped)
        except ValueError as exc:
            raise DeviceFault(FaultCode.NO_ROOM, f"PD {pd.name}: {exc}", index) from None
        self._set_list(index, 1, words)

    def _fill_tx(self, index: int, pdo: int, pd: TxPdSpec, rx: Mapping[str, int]) -> None:
        self._dictionary.make(profile.TX_PD, index)
        self._set_fields(index, pd, rx)
        is_on_change = pd.trigger.on_change is not None
        self._set(index, {Tx.PDO_INDEX: pdo, Tx.ENABLED: True, Tx.ON_CHANGE: is_on_change})

    def _fill_rx(self, index: int, pdo: int, pd: RxPdSpec, tx: Mapping[str, int]) -> None:
        self._dictionary.make(profile.RX_PD, index)
        self._set_fields(index, pd, tx)
        flags = RxFlag.ENABLED | (RxFlag.IGNORE_VERSION if pd.ignore_version else 0)
        self._set(index, {Rx.PDO_INDEX: pdo, Rx.FLAGS: flags})

    def _fill_frame(self, index: int, frame: TxFrameSpec, tx: Mapping[str, int]) -> None:
        self._dictionary.make(profile.TX_FRAME, index)
        self._set_fields(index, frame)
        self._set(index, {FrameSub.ENABLED: True, **_address(frame)})
        self._set_list(index, FrameSub.TXPD, [tx[pd.name] for pd in frame.pds])

    def _set_fields(
        self, index: int, record: Struct, references: Mapping[str, int] = MappingProxyType({})
    ) -> None:
        """Set the entries that are fields of *record*; *references* are those that it may name."""
        values = {}
        for subindex, path, row, is_plain in profile.FIELDS[profile.row_of(index).first]:
            value = _value(record, path)
            if not is_plain and value:
                value = references[value] if row.refers else row.from_plain(value)
            if value or row.default is not None:  # else a new object has it already
                values[subindex] = value
        self._set(index, values)

    def _set_list(self, index: int, first: int, values: Iterable[Any]) -> None:
        numbered = dict(enumerate(values, first))
        last = max(numbered, default=first - 1)
        if last > profile.MAX_ENTRIES:
            detail = f"{len(numbered)} entries, there is room for {profile.MAX_ENTRIES - first + 1}"
            raise DeviceFault(FaultCode.NO_ROOM, detail, index)
        self._dictionary.resize(index, last)
        self._set(index, numbered)

    def _set(self, index: int, values: Mapping[int, Any]) -> None:
        for subindex, value in values.items():
            entry = self._dictionary[index].entries[subindex]
            try:
                octets = entry.kind.encode(value)
            except ValueError as exc:
                raise DeviceFault(FaultCode.NO_ROOM, str(exc), index, subindex) from None
            self._dictionary.put(index, subindex, octets.rstrip(b"\0") if entry.is_text else octets)


def _value(record: Any, path: tuple[str, ...]) -> Any:
    """Return the value at *path* of *record*; of what is not there its default."""
    for name in path:
        record = getattr(_NO_CHANGE if record is None else record, name)
    return record


def _address(frame: TxFrameSpec) -> dict[int, Any]:
    """Return the entries of a TxFrame that say where it goes."""
    if frame.destination == REQUESTER:
        return {FrameSub.ADDRESS_MODE: AddressMode.REQUESTER}
    destination = Destination.parse(frame.destination)
    values: dict[int, Any] = {FrameSub.ADDRESS_MODE: AddressMode[destination.kind.name]}
    if destination.kind is DestinationKind.MAC:
        values[FrameSub.DESTINATION_MAC] = MacAddr.parse(destination.host)
    elif destination.kind is DestinationKind.NET_ID:
        values[FrameSub.DESTINATION_NETID] = NetId.parse(destination.host)
        values[FrameSub.DESTINATION_MAC] = MacAddr.parse(frame.mac) if frame.mac else bytes(6)
    else:
        values[FrameSub.DESTINATION_IP] = IPv4Address(destination.host).packed
        values[FrameSub.PORT_NUMBER] = destination.port
    return values
