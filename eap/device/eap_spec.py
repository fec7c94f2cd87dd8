"""Conversion between the specification of a station and the objects of its EAP ports, both ways.

A variable of the station is an object of its first EAP port; another port has those that it sends.
A received variable is an object of the port that receives it.

Reading back is the check of PreOp to SafeOp (ETG.1005): all references are followed, and a fault
names the object that cannot run.  Objects that are not enabled are left out.

Fields that are one entry each are converted by the table of the profile.  The functions here
convert what takes several objects or entries: references, mappings, lists and addresses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from ipaddress import IPv4Address
from types import MappingProxyType
from typing import Any

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from eap.codec import datatypes
from eap.device.eap_dictionary import EapDictionary
from eap.device.eap_rules import (
    FoundRecord,
    check_station,
    encode_mapping,
    fault_of,
    lay_out_mapping,
)
from eap.device.rollout import bus_variables, types_of
from eap.ids import Destination, DestinationKind, MacAddr, NetId, decode_value, encode_value
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.profiles import eap1000 as profile
from eap.od.profiles.eap1000 import (
    AddressMode,
    Configured,
    FrameSub,
    PortSub,
    Rx,
    RxFlag,
    Tx,
    Var,
)
from eap.od.profiles.table import ProfileObject
from eap.pd.device import DeviceFault, FaultCode
from eap.pd.rules import DESTINATIONS, check_phase, data_budget, frame_budget, is_group
from eap.pd.spec import (
    REQUESTER,
    OnChangeSpec,
    PortKind,
    PortSpec,
    RxPdSpec,
    StationSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Writer,
)

_NO_CHANGE = OnChangeSpec()


def fill(dictionary: EapDictionary, like: EapDictionary | None = None) -> None:
    """Create the objects of the port of *dictionary* from the specification of its station.

    Args:
        dictionary: An empty dictionary.
        like: Another one of the same port; objects of the same name get the same index.

    Raises:
        DeviceFault: the port has more than there are objects for, or a PD more variables than a
            mapping has entries, or a text is too long for its entry.
    """
    _DictionaryFiller(dictionary, like).run()


class _DictionaryFiller:
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
            # Variables of the station alone need one place where clients find them.
            wanted |= {each.name for each in station.variables} - others
        wanted -= received
        return [each.name for each in station.variables if each.name in wanted]

    def run(self) -> None:
        """Create all objects."""
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
        # The same index for the same name keeps the difference of two configurations small.
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
                    detail = f"{len(names)} objects, at most {room}"
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
            if value or row.default is not None:  # otherwise a new object has it already
                values[subindex] = value
        self._set(index, values)

    def _set_list(self, index: int, first: int, values: Iterable[Any]) -> None:
        numbered = dict(enumerate(values, first))
        last = max(numbered, default=first - 1)
        if last > profile.MAX_ENTRIES:
            detail = f"{len(numbered)} entries, at most {profile.MAX_ENTRIES - first + 1}"
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
    """Return the value at *path* of *record*; the default if the parent is None."""
    for name in path:
        record = getattr(_NO_CHANGE if record is None else record, name)
    return record


def _address(frame: TxFrameSpec) -> dict[int, Any]:
    """Return the entries of a TxFrame that hold its destination."""
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


def read_back(station: StationSpec, dictionaries: Mapping[str, EapDictionary]) -> StationSpec:
    """Return *station* with its EAP ports read back from *dictionaries*.

    Records of *station* keep their order, new ones follow; so a dictionary that was filled from a
    specification reads back as that specification.

    Args:
        station: Ports, buses, sources, links, and alternates of RxPDs, which are in no dictionary.
        dictionaries: By name of the port; EAP ports that are missing here send and receive nothing.

    Raises:
        DeviceFault: the engine cannot run it.
    """
    ports = [port for port in station.ports if port.name in dictionaries]
    readers = [PortReader(dictionaries[port.name]) for port in ports]
    found_ports = {reader.name: reader.port() for reader in readers}
    cycle_us, phase_us = _times(station, readers)
    variables = _variables(station, readers)
    frames = [found for reader in readers for found in reader.frames()]
    pds = [found for reader in readers for found in reader.sent]
    subscriptions = [found for reader in readers for found in reader.subscriptions()]
    spec = replace(
        station,
        cycle_us=cycle_us,
        phase_us=phase_us,
        ports=tuple(found_ports.get(port.name, port) for port in station.ports),
        variables=_in_order(variables, station.variables),
        frames=_in_order([each.record for each in frames], station.frames),
        subscriptions=_in_order([each.record for each in subscriptions], station.subscriptions),
    )
    check_station(station, spec, frames, pds, subscriptions)
    # Behind the check: alternates are in no dictionary, and were checked when they were made.
    return _with_alternates(spec, station)


def _with_alternates(spec: StationSpec, station: StationSpec) -> StationSpec:
    """Return *spec* with the alternates of RxPDs that have the same layout in *station*."""
    types = types_of(station)
    known = {_expected(pd, types): pd.alternates for pd in station.subscriptions if pd.alternates}
    if not known:
        return spec
    types = types_of(spec)
    pds = (replace(pd, alternates=known.get(_expected(pd, types), ())) for pd in spec.subscriptions)
    return replace(spec, subscriptions=tuple(pds))


def _expected(pd: RxPdSpec, types: Mapping[str, str]) -> tuple[object, ...]:
    variables = tuple((name, types[name]) for name in pd.variables)
    return pd.name, pd.port, pd.publisher, pd.pd_id, pd.version, variables


def _in_order(records: list[Any], before: tuple[Any, ...]) -> tuple[Any, ...]:
    positions = {each.name: position for position, each in enumerate(before)}
    return tuple(sorted(records, key=lambda each: positions.get(each.name, len(positions))))


def _times(station: StationSpec, readers: list[PortReader]) -> tuple[int, int]:
    """Return device cycle and phase, which must be equal on all ports."""
    found = [reader.times() for reader in readers] or [(station.cycle_us, station.phase_us)]
    for reader, times in zip(readers, found, strict=False):
        if times != found[0]:
            detail = f"{times[0]} us at {times[1]}, but {found[0][0]} at {found[0][1]} on another"
            index, subindex = profile.OBJECT_COUNTS, Configured.DEVICE_CYCLE_TIME
            raise reader.fault(FaultCode.CYCLE_TIME, f"{detail} port", index, subindex)
        for breach in check_phase(*times):
            raise fault_of(breach, profile.OBJECT_COUNTS, reader.name)
    return found[0]


def _variables(station: StationSpec, readers: list[PortReader]) -> list[VariableSpec]:
    """Return the variables of all ports and buses, each once even if several ports have it."""
    on_bus = bus_variables(station)
    merged = {each.name: each for each in station.variables if each.name in on_bus}
    for reader in readers:
        own: set[str] = set()
        for index, variable in reader.variables():
            if variable.name in own or merged.get(variable.name, variable) != variable:
                differs = "" if variable.name in own else ", and differs there"
                detail = f"{variable.name} exists in the station{differs}"
                raise reader.fault(FaultCode.NAME_TWICE, detail, index, Var.NAME)
            own.add(variable.name)
            merged[variable.name] = variable
    return list(merged.values())


class PortReader:
    """Reads the objects of one port.

    Attributes:
        name: Of the port.
        sent: All TxPDs that :meth:`frames` has yielded, each with its frame.
    """

    def __init__(self, dictionary: EapDictionary) -> None:
        self._dictionary = dictionary
        self.name = dictionary.port.name
        self._scheme = dictionary.uri.scheme
        self.sent: list[FoundRecord] = []

    def fault(self, code: FaultCode, detail: str, index: int, subindex: int = 0) -> DeviceFault:
        """Make a fault about an object of this port."""
        return DeviceFault(code, detail, index, subindex, self.name)

    def _values(self, index: int) -> Callable[[int], Any]:
        entries = self._dictionary[index].entries
        return lambda subindex: entries[subindex].value

    def _fields(self, index: int) -> dict[str, Any]:
        """Return the fields that are entries of the object at *index*, records within as dicts."""
        entries = self._dictionary[index].entries
        fields: dict[str, Any] = {}
        for subindex, path, row, is_plain in profile.FIELDS[profile.row_of(index).first]:
            value = entries[subindex].value
            if not is_plain:
                is_name = bool(row.refers)
                value = self._name_at(value, index, subindex) if is_name else row.to_plain(value)
            part = fields
            for record in path[:-1]:
                part = part.setdefault(record, {})
            part[path[-1]] = value
        return fields

    def _name_at(self, target: int, index: int, subindex: int) -> str:
        """Return the name of the PD that a poll request refers to, empty if it is 0."""
        if not target:
            return ""
        if target not in self._dictionary:
            raise self.fault(FaultCode.MISSING_OBJECT, f"PD 0x{target:04X}", index, subindex)
        return self._dictionary.name_of(target)

    def times(self) -> tuple[int, int]:
        """Return device cycle and phase in microseconds."""
        fields = self._fields(profile.OBJECT_COUNTS)
        return fields["cycle_us"], fields["phase_us"]

    def port(self) -> PortSpec:
        """Return the specification of the port."""
        value = self._values(profile.PORT)
        for each in profile.row_of(profile.PORT).entries:
            if each.schemes and value(each.subindex) and self._scheme not in each.schemes:
                detail = f"only on {' and '.join(each.schemes)}, this is {self._scheme}"
                raise self.fault(FaultCode.PORT, detail, profile.PORT, each.subindex)
        if value(PortSub.VLAN_PRIORITY) and not value(PortSub.VLAN_ID):
            detail = "a priority needs a VLAN"
            raise self.fault(FaultCode.PORT, detail, profile.PORT, PortSub.VLAN_PRIORITY)
        # Fields without an entry, such as the interface, stay as the station was started with.
        own = msgspec.to_builtins(self._dictionary.port, enc_hook=encode_value)
        fields = {**own, **self._fields(profile.PORT), "join": list(self._groups())}
        return msgspec.convert(fields, PortSpec, dec_hook=decode_value)

    def _groups(self) -> Iterator[str]:
        for subindex, entry in self._dictionary[profile.GROUPS].entries.items():
            if subindex and entry.value:
                if not is_group(entry.value, self._scheme):
                    detail = f"{entry.value} cannot be joined on {self._scheme}"
                    raise self.fault(FaultCode.PORT, detail, profile.GROUPS, subindex)
                yield entry.value

    def variables(self) -> Iterator[tuple[int, VariableSpec]]:
        """Yield index and record of each variable."""
        for index in self._dictionary.members(*profile.VARIABLES):
            value, fields = self._values(index), self._fields(index)
            if value(Var.DEFAULT_GIVEN):
                kind = self._dictionary[index].entries[Var.DEFAULT].kind
                fields["default"] = kind.to_plain(value(Var.DEFAULT))
            fields.setdefault("writer", Writer.ENGINE)
            yield index, msgspec.convert(fields, VariableSpec)

    def frames(self) -> Iterator[FoundRecord]:
        """Yield each frame that is enabled, with the PDs that are."""
        seen: dict[int, int] = {}
        for index in self._dictionary.members(profile.TX_FRAME):
            listed = list(self._dictionary.listed_pds(index))
            for subindex, pd in listed:
                if pd in seen:
                    detail = f"0x{pd:04X} is in 0x{seen[pd]:04X} too"
                    raise self.fault(FaultCode.PD_IN_TWO_FRAMES, detail, index, subindex)
                if pd not in self._dictionary:
                    detail = f"TxPD 0x{pd:04X}"
                    raise self.fault(FaultCode.MISSING_OBJECT, detail, index, subindex)
                seen[pd] = index
            if self._values(index)(FrameSub.ENABLED):
                yield self._frame(index, [pd for _, pd in listed])
        for pd in self._dictionary.members(profile.TX_PD):
            if pd not in seen and self._values(pd)(Tx.ENABLED):
                raise self.fault(FaultCode.PD_WITHOUT_FRAME, self._dictionary.name_of(pd), pd)

    def _frame(self, index: int, listed: list[int]) -> FoundRecord:
        value = self._values(index)
        enabled = [pd for pd in listed if self._values(pd)(Tx.ENABLED)]
        pds = tuple(self._tx(pd) for pd in enabled)
        if not pds:
            raise self.fault(FaultCode.EMPTY_FRAME, value(FrameSub.NAME), index, FrameSub.TXPD)
        mode = AddressMode(value(FrameSub.ADDRESS_MODE))
        length = self._dictionary.frame_length(index)
        budget = frame_budget(self._scheme, mode.kind)
        if length > budget:
            detail = f"{length} bytes, at most {budget} fit its destination"
            raise self.fault(FaultCode.FRAME_TOO_LONG, detail, index, FrameSub.FRAME_LENGTH)
        record = TxFrameSpec(
            **self._fields(index),
            port=self.name,
            destination=self._destination(index, mode),
            pds=pds,
            mac=_known_mac(value(FrameSub.DESTINATION_MAC)) if mode is AddressMode.NET_ID else "",
        )
        frame = FoundRecord(self.name, index, record)
        self.sent += [
            FoundRecord(self.name, at, pd, frame) for at, pd in zip(enabled, pds, strict=True)
        ]
        return frame

    def _destination(self, index: int, mode: AddressMode) -> str:
        value = self._values(index)
        if (kind := mode.kind) is None:
            return REQUESTER
        if kind not in DESTINATIONS[self._scheme]:
            detail = f"{mode.name} is not an address mode of {self._scheme}"
            raise self.fault(FaultCode.NO_DESTINATION, detail, index, FrameSub.ADDRESS_MODE)
        number = 0
        if kind is DestinationKind.MAC:
            subindex, host = (
                FrameSub.DESTINATION_MAC,
                str(MacAddr(value(FrameSub.DESTINATION_MAC))),
            )
        elif kind is DestinationKind.NET_ID:
            subindex, host = (
                FrameSub.DESTINATION_NETID,
                str(NetId(value(FrameSub.DESTINATION_NETID))),
            )
        else:
            subindex, host = (
                FrameSub.DESTINATION_IP,
                str(IPv4Address(value(FrameSub.DESTINATION_IP))),
            )
            number = value(FrameSub.PORT_NUMBER)
        destination = Destination(kind, host, number)
        # Checked here, because the profile has one entry for addresses of UDP and TCP.
        is_tcp_group = kind is DestinationKind.TCP and destination.is_group
        if not any(value(subindex)) or is_tcp_group:
            raise self.fault(FaultCode.NO_DESTINATION, str(destination), index, subindex)
        return str(destination)

    def _tx(self, index: int) -> TxPdSpec:
        fields = self._fields(index)
        trigger = fields["trigger"]
        # A nonzero time enables sending on change even if the entry Tx.ON_CHANGE is 0.
        if not (self._values(index)(Tx.ON_CHANGE) or any(trigger["on_change"].values())):
            trigger["on_change"] = None
        return msgspec.convert({**fields, "variables": self._mapped(index)}, TxPdSpec)

    def subscriptions(self) -> Iterator[FoundRecord]:
        """Yield each RxPD that is enabled."""
        for index in self._dictionary.members(profile.RX_PD):
            flags = self._values(index)(Rx.FLAGS)
            if not flags & RxFlag.ENABLED:
                continue
            fields = self._fields(index)
            if flags & RxFlag.IGNORE_NETID:
                fields["publisher"] = ""
            fields["ignore_version"] = bool(flags & RxFlag.IGNORE_VERSION)
            mapped = {"port": self.name, "variables": self._mapped(index)}
            yield FoundRecord(self.name, index, msgspec.convert({**fields, **mapped}, RxPdSpec))

    def _mapped(self, index: int) -> tuple[str, ...]:
        """Return the names of the variables of a PD; its PDO must exist and be complete."""
        dictionary, pdo = self._dictionary, self._values(index)(Tx.PDO_INDEX)
        name = dictionary.name_of(index)
        if not pdo:
            raise self.fault(FaultCode.NO_PDO, name, index, Tx.PDO_INDEX)
        if pdo not in dictionary:
            detail = f"PDO 0x{pdo:04X} of {name}"
            raise self.fault(FaultCode.MISSING_OBJECT, detail, index, Tx.PDO_INDEX)
        try:
            count = dictionary[pdo].max_subindex
            placed = lay_out_mapping(dictionary, pdo, count, data_budget(self._scheme))
        except SdoAbortError as exc:
            is_long = exc.code == AbortCode.PDO_LENGTH
            code = FaultCode.FRAME_TOO_LONG if is_long else FaultCode.BAD_MAPPING
            raise self.fault(code, str(exc), pdo, exc.subindex) from None
        if not placed.indexes:
            raise self.fault(FaultCode.EMPTY_PDO, f"PDO of {name}", pdo)
        return tuple(dictionary.name_of(each) for each in placed.indexes)


def _known_mac(octets: bytes) -> str:
    """Return the MAC address of a NetID; empty if it is zero or a group, so that it is learned."""
    address = MacAddr(octets)
    return str(address) if any(address) and not address.is_group else ""
