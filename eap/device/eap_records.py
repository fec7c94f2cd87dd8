"""From the objects of a station's EAP ports back to its specification: what the engine is to run.

This is the check of PreOp to SafeOp (ETG.1005): all references are followed, and whatever cannot
run is refused with the object that it is about.  Objects that are not enabled are left out.

Fields that are one entry each are converted as the table of the profile says; the functions here
read what takes several objects or entries: references, mappings, lists and addresses.

The rules for the station as a whole are those of a plant file (``eap.pd.rules``), as far as one
station can break them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from ipaddress import IPv4Address
from itertools import chain
from typing import Any, NamedTuple

import msgspec
from msgspec.structs import replace

from eap.device.eap_dictionary import EapDictionary
from eap.device.eap_rules import lay_out_mapping
from eap.device.pdlayout import bus_variables, types_of
from eap.ids import Destination, DestinationKind, InterfaceUri, MacAddr, NetId
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
from eap.pd import rules
from eap.pd.device import DeviceFault, FaultCode
from eap.pd.rules import DESTINATIONS, Breach, check_phase, data_budget, frame_budget, is_group
from eap.pd.spec import (
    REQUESTER,
    EngineSource,
    PortSpec,
    RxPdSpec,
    StationSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Writer,
)


def read_back(station: StationSpec, dictionaries: Mapping[str, EapDictionary]) -> StationSpec:
    """Return what *station* is with its EAP ports as *dictionaries* say.

    What stood in *station* keeps its place, new things come behind; so what was filled from a
    specification reads back as that specification.

    Args:
        station: Ports, buses, sources, links, and alternates of RxPDs, which are in no dictionary.
        dictionaries: By name of the port; EAP ports that are missing here send and receive nothing.

    Raises:
        DeviceFault: it cannot run.
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
    return _with_alternates(spec, station)


def _with_alternates(spec: StationSpec, station: StationSpec) -> StationSpec:
    """Return *spec* with the alternates of those RxPDs that are laid out as *station* has them."""
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
    places = {each.name: lay_out_mapping for lay_out_mapping, each in enumerate(before)}
    return tuple(sorted(records, key=lambda each: places.get(each.name, len(places))))


def _times(station: StationSpec, readers: list[PortReader]) -> tuple[int, int]:
    """Return device cycle and phase, which all ports have to agree on."""
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
    """Return the variables of all ports and of the buses; equal ones of several ports are one."""
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
        """Return the port as it is to be."""
        value = self._values(profile.PORT)
        for each in profile.row_of(profile.PORT).entries:
            if each.schemes and value(each.subindex) and self._scheme not in each.schemes:
                detail = f"only on {' and '.join(each.schemes)}, this is {self._scheme}"
                raise self.fault(FaultCode.PORT, detail, profile.PORT, each.subindex)
        if value(PortSub.VLAN_PRIORITY) and not value(PortSub.VLAN_ID):
            detail = "a priority needs a VLAN"
            raise self.fault(FaultCode.PORT, detail, profile.PORT, PortSub.VLAN_PRIORITY)
        fields = {**msgspec.to_builtins(self._dictionary.port), **self._fields(profile.PORT)}
        return msgspec.convert({**fields, "join": list(self._groups())}, PortSpec)

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
            detail = f"{length} octets, at most {budget} go there"
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
            detail = f"{mode.name} is no way to address from {self._scheme}"
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
        is_tcp_group = kind is DestinationKind.TCP and destination.is_group
        if not any(value(subindex)) or is_tcp_group:
            raise self.fault(FaultCode.NO_DESTINATION, str(destination), index, subindex)
        return str(destination)

    def _tx(self, index: int) -> TxPdSpec:
        fields = self._fields(index)
        trigger = fields["trigger"]
        # Its times switch sending on change on, as they do without such an entry.
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
        """Return the names of a PD's variables; its PDO has to be there and whole."""
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
    """Return the address behind a NetID; empty if it is to be learned, as a group has no owner."""
    address = MacAddr(octets)
    return str(address) if any(address) and not address.is_group else ""


class FoundRecord(NamedTuple):
    """A record with where it stands; of a TxPD with the Found of its frame."""

    port: str
    at: int
    """Index of its object."""
    record: Any
    frame: Any = None

    def fault(self, code: FaultCode, detail: str, subindex: int = 0) -> DeviceFault:
        """Make a fault about it."""
        return DeviceFault(code, detail, self.at, subindex, self.port)

    def refuse(self, breaches: Iterable[Breach]) -> None:
        """Raise a DeviceFault for the first of *breaches*, at the entry that it names."""
        for breach in breaches:
            raise fault_of(breach, self.at, self.port)


def fault_of(breach: Breach, index: int, port: str) -> DeviceFault:
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
    """Refuse what cannot run.

    Args:
        before: The station whose sources and links *spec* has.
        spec: What was read back.
        frames: Its TxFrames.
        pds: Its TxPDs.
        subscriptions: Its RxPDs.

    Raises:
        DeviceFault: for the first object that is wrong.
    """
    _check_unique(frames, FrameSub.NAME, "frame")
    _check_unique(pds, Tx.NAME, "sent PD")
    _check_unique(subscriptions, Rx.NAME, "received PD")
    uris = {port.name: InterfaceUri.parse(port.interface) for port in spec.ports}
    for found in frames:
        found.refuse(_breaches_of_frame(found.record, uris[found.port]))
    for found in pds:
        found.refuse(_breaches_of_pd(found.record, found.frame.record, spec.cycle_us))
    for second, first in rules.doubles(((each.port, each.record.pd_id), each) for each in pds):
        detail = f"{second.record.pd_id} is that of {first.record.name} too"
        raise second.fault(FaultCode.PD_ID_TWICE, detail, Tx.PD_ID)
    _check_received(spec, subscriptions)
    _check_polls(pds, subscriptions)
    _check_station_needs(before, spec, subscriptions)


def _check_unique(found: Iterable[FoundRecord], subindex: int, what: str) -> None:
    for second, first in rules.doubles((each.record.name, each) for each in found):
        detail = f"{what} {first.record.name} is 0x{first.at:04X} of {first.port} already"
        raise second.fault(FaultCode.NAME_TWICE, detail, subindex)


def _breaches_of_frame(frame: TxFrameSpec, uri: InterfaceUri) -> Iterator[Breach]:
    is_answer = frame.destination == REQUESTER
    destination = None if is_answer else Destination.parse(frame.destination)
    return chain(
        rules.check_modulo(frame.name, frame.divider, frame.modulo or None),
        rules.check_answers(frame),
        chain.from_iterable(rules.check_frame_of(pd, frame) for pd in frame.pds),
        rules.check_monitoring(frame, destination, uri),
    )


def _breaches_of_pd(pd: TxPdSpec, frame: TxFrameSpec, cycle_us: int) -> Iterator[Breach]:
    trigger = pd.trigger
    return chain(
        rules.check_polled(pd),
        rules.check_triggers(pd),
        rules.check_modulo(pd.name, trigger.divider, trigger.modulo or None),
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
    """Refuse requests that are not there, and those that are answers themselves."""
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
    """Refuse variables that sources and links of the station do not find as they need them."""
    now = {each.name: each for each in spec.variables}
    types = {each.name: each.type for each in before.variables}
    received = {name for each in subscriptions for name in each.record.variables}
    writers: dict[str, Writer] = {}
    for source in before.sources:
        is_engine = isinstance(source, EngineSource)
        writers[source.variable] = Writer.ENGINE if is_engine else Writer.SERVICES
    writers |= {link.target: Writer.ENGINE for link in before.links}
    for name in dict.fromkeys([*writers, *(link.source for link in before.links)]):
        if name not in now:
            raise DeviceFault(FaultCode.IN_USE, f"a source or a link needs {name}")
        if now[name].type != types.get(name, now[name].type):
            detail = f"{name} is {now[name].type}, a source or a link needs {types[name]}"
            raise DeviceFault(FaultCode.IN_USE, detail)
        if name in writers and (name in received or now[name].writer is not writers[name]):
            detail = f"{name} is filled by a source or a link"
            raise DeviceFault(FaultCode.WRITER, detail)
