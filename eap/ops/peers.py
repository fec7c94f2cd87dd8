"""TwinCAT's side of a station: the publishers and subscribers that match it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TypeAlias

import msgspec

from eap.codec import datatypes
from eap.codec.arrays import Array
from eap.codec.basetypes import Block, Boolean, DataType, Integer, String
from eap.config.imports.records import ARP_MS, EapBox, EapImportDevice, EapVariable
from eap.config.imports.treeitems import device_items, tree_items_text
from eap.config.load import Plant
from eap.config.ports import IP_BROADCAST
from eap.errors import ConfigError, EnvironmentalError
from eap.ids import BROADCAST_MAC, Destination, DestinationKind, NetId
from eap.ops.plant import load_or_raise
from eap.pd.spec import REQUESTER, PortKind, PortSpec, RxPdSpec, StationSpec, TxFrameSpec, TxPdSpec
from eap.runtime.durable import whole_file
from eap.suggest import suggest

_Periods: TypeAlias = dict[tuple[str, str, str], str]
"""Time between two of a variable, by device, box and name."""
_NO_PERIODS: Mapping[str, str] = MappingProxyType({})
_ODD_SIZE = re.compile(r"U?INT(24|40|48|56)|BIT\d", re.ASCII)


class PeerRow(msgspec.Struct, frozen=True, kw_only=True):
    """One variable of a publisher or subscriber, as a person types it in TwinCAT.

    Attributes:
        device: EAP device.
        box: Publisher or subscriber.
        kind: ``publisher`` or ``subscriber``.
        variable: Name of the network variable.
        id: Variable ID.
        version: Data type version.
        type: Data type.
        bytes: Its size.
        address: Publisher: destination; subscriber: NetID of the publisher, and its group.
        period: Time between two of it.
    """

    device: str
    box: str
    kind: str
    variable: str
    id: int
    version: int
    type: str
    bytes: int
    address: str
    period: str = ""


class PeerReport(msgspec.Struct, frozen=True, kw_only=True):
    """``eapctl export-peer``."""

    station: str
    rows: tuple[PeerRow, ...]
    remarks: tuple[str, ...] = ()
    files: tuple[str, ...] = ()


def peer_report(file: Path, station: str) -> tuple[tuple[EapImportDevice, ...], PeerReport]:
    """Return TwinCAT's devices for *station* of the plant in *file*, and their table.

    Raises:
        ConfigError: the plant has errors, or no such station.
    """
    plant = load_or_raise(file)
    known = {each.name: each for each in plant.stations}
    if station not in known:
        hint = suggest(station, known) or f"; known stations: {', '.join(known)}"
        raise ConfigError(f"unknown station {station!r}{hint}")
    builder = _PeerBuilder(plant, known[station])
    devices = builder.devices()
    rows = tuple(row for device in devices for row in _rows(device, builder.periods))
    return devices, PeerReport(station=station, rows=rows, remarks=tuple(builder.remarks))


def write_peer(
    devices: Sequence[EapImportDevice],
    report: PeerReport,
    target: Path,
    *,
    force: bool,
    is_folder: bool = False,
) -> PeerReport:
    """Write the XML descriptions of *devices*: one file, or one for each item in a folder.

    Args:
        devices: Of the other side.
        report: Of them.
        target: A file, or a folder.
        force: Overwrite files.
        is_folder: *target* is a folder, which is made if it is not there.

    Raises:
        ConfigError: a file exists and *force* is not set.
        EnvironmentalError: a file or the folder cannot be written.
    """
    if is_folder:
        try:
            target.mkdir(exist_ok=True)
        except OSError as exc:
            raise EnvironmentalError(f"{target} cannot be written: {exc.strerror}") from None
    files: dict[Path, str] = {target: tree_items_text(devices)}
    if target.is_dir():
        items = [item for device in devices for item in device_items(device)]
        files = {
            target / f"{number:03} {_file_name(path)}.xml": text
            for number, (path, text) in enumerate(items, 1)
        }
    for path in files:
        if path.exists() and not force:
            raise ConfigError(f"{path} exists: overwrite it with --force")
    for path, text in files.items():
        with whole_file(path) as file:
            file.write(text.encode())
    return msgspec.structs.replace(report, files=tuple(str(each) for each in files))


def twincat_type(kind: DataType) -> str:
    """Return the type in TwinCAT that has the bytes of *kind*."""
    if isinstance(kind, Array):
        shape = ",".join(f"{each.low}..{each.low + each.size - 1}" for each in kind.dimensions)
        return f"ARRAY [{shape}] OF {twincat_type(kind.element)}"
    if kind.alias_of is not None:
        return kind.name
    if isinstance(kind, Boolean):
        return "BOOL"
    if isinstance(kind, String) and kind.size > 1:
        return f"STRING({kind.size - 1})"
    is_odd = isinstance(kind, Integer) and _ODD_SIZE.fullmatch(kind.name)
    if isinstance(kind, Block | String) or is_odd:
        return _octets(kind.size)
    return kind.name


def _octets(size: int) -> str:
    return "BYTE" if size == 1 else f"ARRAY [0..{size - 1}] OF BYTE"


def _file_name(path: str) -> str:
    return re.sub(r"[^\w ()-]+", " ", path.partition("^")[2]).strip() or "item"


class _PeerBuilder:
    """Devices of the other side while they are made."""

    def __init__(self, plant: Plant, station: StationSpec) -> None:
        self._station = station
        self._others = [each for each in plant.stations if each.name != station.name]
        self._types = _types(station)
        self._devices: dict[tuple[str, str], EapImportDevice] = {}
        self.periods: _Periods = {}
        self.remarks: list[str] = []

    def devices(self) -> tuple[EapImportDevice, ...]:
        """Return one device for each port of another controller."""
        for port in self._station.ports:
            if port.kind is PortKind.EAP:
                self._add_publishers(port)
                self._add_subscribers(port)
        return tuple(self._devices.values())

    def _add_publishers(self, port: PortSpec) -> None:
        """Add the publishers of what the station receives at *port*."""
        received: dict[str, list[RxPdSpec]] = {}
        for each in self._station.subscriptions:
            if each.port == port.name:
                received.setdefault(each.publisher, []).append(each)
        for publisher, subscriptions in received.items():
            sender = self._sender(publisher)
            if sender is None:
                self._add_foreign(port, publisher, subscriptions)
                continue
            other, other_port = sender
            wanted = {each.pd_id for each in subscriptions}
            for frame in other.frames:
                pds = [pd for pd in frame.pds if pd.pd_id in wanted]
                if frame.port != other_port.name or not pds:
                    continue
                if frame.destination == REQUESTER:
                    self._remark_poll(f"{other.name}/{frame.name}")
                    continue
                box = self._publisher_box(frame, pds, other, other_port)
                self._add_box(self._device_of(other, other_port), box, _periods(frame, pds, other))

    def _add_foreign(
        self, port: PortSpec, publisher: str, subscriptions: Sequence[RxPdSpec]
    ) -> None:
        uri = port.interface
        is_udp = uri.scheme in {"udp", "tcp"}
        box = EapBox(
            name=f"to {self._station.name}",
            is_publisher=True,
            net_id=None if is_udp else port.net_id,
            udp=uri.host if is_udp else "",
            vlan_id=port.vlan_id,
            vlan_priority=port.vlan_priority,
            variables=tuple(
                self._variable(each.name, each.pd_id, each.version, each.variables, self._types)
                for each in subscriptions
            ),
        )
        title = publisher or "any controller"
        key = title, ""
        if key not in self._devices:
            net_id = NetId.parse(publisher) if publisher else None
            self._devices[key] = EapImportDevice(name=f"EAP {title}", net_id=net_id)
        self._add_box(key, box)

    def _publisher_box(
        self, frame: TxFrameSpec, pds: Sequence[TxPdSpec], other: StationSpec, port: PortSpec
    ) -> EapBox:
        types = _types(other)
        mac = udp = ""
        net_id = None
        destination = Destination.parse(frame.destination)
        match destination.kind:
            case DestinationKind.MAC:
                mac = destination.host
            case DestinationKind.NET_ID:
                net_id = NetId.parse(destination.host)
            case _:
                udp = destination.host
        return EapBox(
            name=frame.name,
            is_publisher=True,
            net_id=net_id,
            mac=mac,
            udp=udp,
            divider=frame.divider or 1,
            modulo=frame.modulo,
            vlan_id=port.vlan_id,
            vlan_priority=port.vlan_priority,
            arp_ms=frame.monitor_interval_ms or ARP_MS,
            is_monitored=bool(frame.monitor_interval_ms),
            is_changeable=frame.changeable,
            variables=tuple(
                self._variable(pd.name, pd.pd_id, pd.version, pd.variables, types) for pd in pds
            ),
        )

    def _add_subscribers(self, port: PortSpec) -> None:
        """Add the subscribers to what the station sends from *port*."""
        for frame in self._station.frames:
            if frame.port != port.name:
                continue
            if frame.destination == REQUESTER:
                self._remark_poll(f"{self._station.name}/{frame.name}")
                continue
            receivers = list(self._receivers(port, frame))
            for other, other_port, pds in receivers:
                box = self._subscriber_box(frame, pds, port)
                periods = _periods(frame, pds, self._station)
                self._add_box(self._device_of(other, other_port), box, periods)
            if not receivers:
                key = "other controllers", ""
                self._devices.setdefault(key, EapImportDevice(name="EAP other controllers"))
                box = self._subscriber_box(frame, frame.pds, port)
                self._add_box(key, box, _periods(frame, frame.pds, self._station))

    def _receivers(
        self, port: PortSpec, frame: TxFrameSpec
    ) -> Iterator[tuple[StationSpec, PortSpec, list[TxPdSpec]]]:
        for other in self._others:
            for other_port in other.ports:
                taken = {
                    each.pd_id
                    for each in other.subscriptions
                    if each.port == other_port.name and each.publisher in {"", str(port.net_id)}
                }
                if pds := [pd for pd in frame.pds if pd.pd_id in taken]:
                    yield other, other_port, pds

    def _subscriber_box(
        self, frame: TxFrameSpec, pds: Iterable[TxPdSpec], port: PortSpec
    ) -> EapBox:
        destination = Destination.parse(frame.destination)
        # Broadcasts come to every subscriber: there is no group to receive from.
        is_group = destination.is_group and destination.host not in {
            str(BROADCAST_MAC),
            IP_BROADCAST,
        }
        is_mac = destination.kind is DestinationKind.MAC
        return EapBox(
            name=f"from {self._station.name} {frame.name}",
            is_publisher=False,
            net_id=port.net_id,
            mac=destination.host if is_group and is_mac else "",
            udp=destination.host if is_group and not is_mac else "",
            variables=tuple(
                self._variable(pd.name, pd.pd_id, pd.version, pd.variables, self._types)
                for pd in pds
            ),
        )

    def _remark_poll(self, frame: str) -> None:
        self.remarks.append(
            f"frame {frame} answers polls: TwinCAT's files have no known form of that"
        )

    def _variable(
        self,
        name: str,
        pd_id: int,
        version: int,
        variables: Sequence[str],
        types: dict[str, DataType],
    ) -> EapVariable:
        kinds = [types[each] for each in variables]
        size = datatypes.layout(kinds).size
        kind = twincat_type(kinds[0]) if len(kinds) == 1 else _octets(size)
        if len(kinds) > 1:
            parts = ", ".join(f"{each} {twincat_type(types[each])}" for each in variables[:8])
            more = "" if len(variables) <= 8 else f" and {len(variables) - 8} more"
            remark = f"PD {pd_id} ({name}) carries {parts}{more}: a struct with pack_mode 1"
            if any(each.is_bits for each in kinds):
                remark += ", its bits packed in bytes"
            if remark not in self.remarks:
                self.remarks.append(remark)
        return EapVariable(name=name, nv_id=pd_id, type=kind, bits=8 * size, version=version)

    def _sender(self, publisher: str) -> tuple[StationSpec, PortSpec] | None:
        for other in self._others:
            for port in other.ports:
                if publisher and str(port.net_id) == publisher:
                    return other, port
        return None

    def _device_of(self, other: StationSpec, port: PortSpec) -> tuple[str, str]:
        key = other.name, port.name
        if key not in self._devices:
            several = len([each for each in other.ports if each.kind is PortKind.EAP]) > 1
            self._devices[key] = EapImportDevice(
                name=f"EAP {other.name} {port.name}" if several else f"EAP {other.name}",
                net_id=port.net_id,
                cycle_us=other.cycle_us,
            )
        return key

    def _add_box(
        self, key: tuple[str, str], box: EapBox, periods: Mapping[str, str] = _NO_PERIODS
    ) -> None:
        device = self._devices[key]
        for name, period in periods.items():
            self.periods[device.name, box.name, name] = period
        self._devices[key] = msgspec.structs.replace(device, boxes=(*device.boxes, box))


def _types(station: StationSpec) -> dict[str, DataType]:
    return {each.name: datatypes.parse(each.type) for each in station.variables}


def _periods(frame: TxFrameSpec, pds: Iterable[TxPdSpec], sender: StationSpec) -> dict[str, str]:
    """Return the time between two of each PD, by its name."""
    found = {}
    for pd in pds:
        divider = max(frame.divider, pd.trigger.divider, 1)
        found[pd.name] = f"{(pd.trigger.cycle_us or sender.cycle_us * divider) / 1000:g} ms"
        if pd.trigger.on_change is not None:
            found[pd.name] = "on change"
        elif pd.trigger.event:
            found[pd.name] = "on event"
    return found


def _rows(device: EapImportDevice, periods: _Periods) -> Iterator[PeerRow]:
    for box in device.boxes:
        for variable in box.variables:
            yield PeerRow(
                device=device.name,
                box=box.name,
                kind="publisher" if box.is_publisher else "subscriber",
                variable=variable.name,
                id=variable.nv_id,
                version=variable.version,
                type=variable.type,
                bytes=variable.bits // 8,
                address=_address(box),
                period=periods.get((device.name, box.name, variable.name), ""),
            )


def _address(box: EapBox) -> str:
    group = f"UDP {box.udp}" if box.udp else box.mac
    if box.is_publisher:
        return group or (f"NetID {box.net_id}" if box.net_id else "")
    return " ".join(filter(None, (f"NetID {box.net_id}" if box.net_id else "", group)))
