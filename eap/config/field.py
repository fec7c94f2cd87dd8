"""Checks of the keys ``s7`` and ``modbus``, of sources and targets in controllers; layouts.

Both protocols have the same form: controllers that the stations name, and a server whose addresses
are computed here, so that the plant file alone says where a variable is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

from msgspec import Struct
from msgspec.structs import replace

from eap.codec import datatypes
from eap.codec.basetypes import DataType
from eap.codec.fieldaddresses import (
    MAX_UNITS,
    FieldPlace,
    FieldPoint,
    modbus_point,
    place_text,
    register_bit,
    s7_point,
    unit_bits,
)
from eap.codec.fieldtypes import FieldType, aligned, coil_type, modbus_type, s7_type
from eap.codec.modbus import ModbusTable
from eap.config.bridge_sections import (
    ControllerSection,
    FieldServer,
    FieldServerSection,
    ModbusBridge,
    ModbusController,
    ModbusSection,
    ModbusServerSection,
    Order,
    S7Bridge,
    S7Section,
    S7ServerSection,
    ServedItem,
    ServedSection,
)
from eap.config.finding import FindingReport, one_of
from eap.config.index import Index
from eap.config.listen import parse_listen
from eap.config.ports import check_names
from eap.config.selection import VariableNames, reason_not_settable
from eap.config.structs import StationSection
from eap.config.variables import named_part
from eap.ids import parse_host
from eap.patterns import match_names
from eap.pd.spec import FieldSource, S7Source, S7Target, Source, Target
from eap.suggest import suggest

_LISTEN = "ADDRESS:PORT, such as 127.0.0.1:1102"
MAX_SERVED = 10_000
"""Variables that one bridge serves."""


def check_field(index: Index, report: FindingReport) -> None:
    """Report invalid controllers, addresses in them, and servers."""
    plant = index.plant
    controllers = [*_controllers(plant.s7), *_controllers(plant.modbus)]
    check_names([(each.at, name) for name, each in controllers], "controller", report)
    for _, controller in controllers:
        _check_controller(controller, report)
    for station in plant.stations:
        for name, source in station.sources.items():
            if isinstance(source, FieldSource):
                _check_point(index, station, f"{station.at}.sources.{name}", source, report)
        _check_targets(index, station, report)
    served = _Served(index, report)
    if plant.s7 is not None and plant.s7.server is not None:
        served.check_s7(plant.s7.server)
    if plant.modbus is not None and plant.modbus.server is not None:
        served.check_modbus(plant.modbus.server)


def _controllers(
    section: S7Section | ModbusSection | None,
) -> list[tuple[str, ControllerSection]]:
    return [] if section is None else list(section.controllers.items())


def _check_targets(index: Index, station: StationSection, report: FindingReport) -> None:
    taken: list[tuple[str, FieldPoint]] = []
    for name, target in station.targets.items():
        path = f"{station.at}.targets.{name}"
        named_part(index, report, station, path, name)
        point = _check_point(index, station, path, target, report)
        if point is None:
            continue
        for controller, other in taken:
            if controller == target.controller and _overlap(point, other):
                message = f"{target.address} of {controller} is written by two targets"
                report.add(f"{path}.address", message, "a place of its own")
        taken.append((target.controller, point))


def _check_controller(controller: ControllerSection, report: FindingReport) -> None:
    path, expected = f"{controller.at}.host", "an IPv4 address or a name; port is a key of its own"
    try:
        _, port = parse_host(controller.host, 0)
    except ValueError as exc:
        report.add(path, str(exc), expected)
    else:
        if port:
            report.add(path, f"{controller.host!r} has a port", expected)
    if controller.timeout_ms <= controller.every_ms:
        message = f"timeout_ms is {controller.timeout_ms}, every_ms is {controller.every_ms}"
        report.add(f"{controller.at}.timeout_ms", message, "a time-out longer than the period")


def _check_point(
    index: Index,
    station: StationSection,
    path: str,
    found: FieldSource | Target,
    report: FindingReport,
) -> FieldPoint | None:
    key = "s7" if isinstance(found, S7Source | S7Target) else "modbus"
    known = dict(_controllers(index.plant.s7 if key == "s7" else index.plant.modbus))
    controller = known.get(found.controller)
    if controller is None:
        if found.controller not in report.broken:
            message = f"unknown {key} controller {found.controller!r}"
            message += suggest(found.controller, known)
            expected = one_of(known) if known else f"a controller of the key {key} of the plant"
            report.add(f"{path}.controller", message, expected)
        return None
    try:
        part = index.part(station, found.variable)
    except ValueError:
        return None  # reported with the variable
    if part is None:
        return None
    try:
        return address_point(part.kind, found.address, found.type, controller)
    except ValueError as exc:
        where = "type" if found.type else "address"
        report.add(f"{path}.{where}", f"{found.variable}: {exc}", "an address that fits")
    return None


def address_point(
    kind: DataType, address: str, text: str, controller: ControllerSection
) -> FieldPoint:
    """Return the place of a value in a controller; raise ValueError if it is none.

    Args:
        kind: Type of the variable.
        address: As in the plant file.
        text: Type in the controller, empty for that of the variable.
        controller: The controller.
    """
    if isinstance(controller, ModbusController):
        return modbus_point(
            kind,
            address,
            text,
            words_swapped=controller.word_order is Order.LITTLE,
            bytes_swapped=controller.byte_order is Order.LITTLE,
        )
    return s7_point(kind, address, text)


def _overlap(one: FieldPoint, other: FieldPoint) -> bool:
    return (
        one.place.area == other.place.area
        and one.place.bit < other.end
        and other.place.bit < one.end
    )


class _Layout:
    """Addresses of one area: those that are taken, and the next one."""

    def __init__(self, area: str, *, words_swapped: bool, bytes_swapped: bool) -> None:
        self.area = area
        self._taken: list[tuple[str, FieldPoint]] = []
        self._end = self._top = 0
        self._swapped = words_swapped, bytes_swapped

    def place(self, name: str, kind: DataType, section: ServedSection, first: str) -> FieldPoint:
        """Return the address of a variable, *first* if that is given; raise ValueError if none."""
        field = self._type(kind, section.type, first)
        unit = unit_bits(self.area)
        if first:
            start = self._start(first, unit, field)
        else:
            start = aligned(self._end, max(field.align, 1 if unit != 16 else 16))
        point = FieldPoint(FieldPlace(self.area, start), field)
        if point.end > MAX_UNITS * unit:
            raise ValueError("it ends behind the last address")
        # Behind all others there is nothing to compare with.
        for other, theirs in self._taken if start < self._top else ():
            if _overlap(point, theirs):
                raise ValueError(f"{place_text(point)} is that of {other}, too")
        self._taken.append((name, point))
        self._end = point.end
        self._top = max(self._top, point.end)
        return point

    def _type(self, kind: DataType, text: str, first: str) -> FieldType:
        if unit_bits(self.area) == 8:
            return s7_type(kind, text)
        if unit_bits(self.area) == 1 or "." in first:
            return coil_type(kind)
        words, octets = self._swapped
        return modbus_type(kind, text, words_swapped=words, bytes_swapped=octets)

    def _start(self, first: str, unit: int, field: FieldType) -> int:
        number, separator, bit = first.partition(".")
        if not number.isdecimal() or (separator and not bit.isdecimal()) or len(first) > 8:
            raise ValueError(f"{first!r} is no address: expected a number such as 4, or 4.1")
        if not separator:
            return unit * int(number)
        if field.bits != 1 or int(bit) >= unit:
            raise ValueError(f"{first!r} is a bit: expected one for {field.text}")
        return register_bit(int(number), int(bit)) if unit == 16 else 8 * int(number) + int(bit)


class _ServedArea(NamedTuple):
    """Area of a server with its sections."""

    layout: _Layout
    sections: Iterable[ServedSection]
    path: str


class _Served:
    def __init__(self, index: Index, report: FindingReport) -> None:
        self._index = index
        self._report = report
        self._names = VariableNames(index, report)

    def check_s7(self, server: S7ServerSection) -> None:
        """Report what of data blocks cannot be served."""
        self._check_server(server)
        for area in self._blocks(server):
            list(self.items(area))

    def check_modbus(self, server: ModbusServerSection) -> None:
        """Report what of registers cannot be served."""
        self._check_server(server)
        for area in self._tables(server):
            list(self.items(area))

    def s7(self, server: S7ServerSection) -> FieldServer:
        """Return the server with all addresses."""
        items = tuple(item for area in self._blocks(server) for item in self.items(area))
        return FieldServer(server.listen, server.every_ms, items)

    def modbus(self, server: ModbusServerSection) -> FieldServer:
        """Return the server with all addresses."""
        items = tuple(item for area in self._tables(server) for item in self.items(area))
        words, octets = server.word_order is Order.LITTLE, server.byte_order is Order.LITTLE
        return FieldServer(server.listen, server.every_ms, items, server.unit, words, octets)

    def _check_server(self, server: FieldServerSection) -> None:
        try:
            parse_listen(server.listen)
        except ValueError as exc:
            self._report.add(f"{server.at}.listen", str(exc), _LISTEN)

    def _blocks(self, server: S7ServerSection) -> Iterator[_ServedArea]:
        for key, sections in server.blocks.items():
            path = f"{server.at}.blocks.{key}"
            number = key.upper().removeprefix("DB")
            if not number.isdecimal() or not 1 <= int(number[:6]) <= 0xFFFF:
                self._report.add(path, f"data block {key!r}", "a number from 1 to 65535")
                continue
            layout = _Layout(f"DB{int(number)}", words_swapped=False, bytes_swapped=False)
            yield _ServedArea(layout, sections, path)

    def _tables(self, server: ModbusServerSection) -> Iterator[_ServedArea]:
        words, octets = server.word_order is Order.LITTLE, server.byte_order is Order.LITTLE
        for table in ModbusTable:
            layout = _Layout(table, words_swapped=words, bytes_swapped=octets)
            sections: tuple[ServedSection, ...] = getattr(server, table)
            yield _ServedArea(layout, sections, f"{server.at}.{table}")

    def items(self, area: _ServedArea) -> Iterator[ServedItem]:
        """Yield the variables of an area with their addresses; what is wrong is reported."""
        count = 0
        for section in area.sections:
            first = section.first
            for name in self._selected(section):
                count += 1
                if count > MAX_SERVED:
                    message = f"more than {MAX_SERVED} variables"
                    self._report.add(area.path, message, "fewer, or another block")
                    return
                if (item := self._item(area, section, name, first)) is not None:
                    yield item
                first = ""

    def _selected(self, section: ServedSection) -> list[str]:
        path = f"{section.at}.of" if f"{section.at}.of" in self._report.lines else section.at
        self._names.check_pattern(path, section.of)
        if "*" not in section.of:
            return [section.of]
        return match_names(section.of, self._names.names)

    def _item(
        self, area: _ServedArea, section: ServedSection, name: str, first: str
    ) -> ServedItem | None:
        station_name, _, variable = name.partition("/")
        station = self._index.stations.get(station_name)
        try:
            part = None if station is None else self._index.part(station, variable)
        except ValueError:
            return None  # reported with the variable
        if station is None or part is None:
            return None
        if section.write:
            self._check_write(area.layout.area, station, variable, section)
        try:
            point = area.layout.place(name, part.kind, section, first)
        except ValueError as exc:
            self._report.add(section.at, f"{name}: {exc}", "an address and type that fit")
            return None
        text = place_text(point)
        return ServedItem(name, part.kind.text, text, section.type, section.write)

    def _check_write(
        self, area: str, station: StationSection, variable: str, section: ServedSection
    ) -> None:
        path = f"{section.at}.write"
        if area in {ModbusTable.INPUT, ModbusTable.DISCRETE}:
            self._report.add(path, f"clients cannot write {area}", "coil or holding")
        elif why := reason_not_settable(self._index, station, variable):
            message = f"{station.name}/{variable} cannot be written: {why}"
            self._report.add(path, message, "a variable without source and link")


def resolved_source(index: Index, source: Source) -> Source:
    """Return a source with the time-out and substitute of its controller where it has none."""
    if not isinstance(source, FieldSource):
        return source
    is_s7 = isinstance(source, S7Source)
    controllers = dict(_controllers(index.plant.s7 if is_s7 else index.plant.modbus))
    controller = controllers[source.controller]
    return replace(
        source,
        timeout_ms=source.timeout_ms or controller.timeout_ms,
        substitute=source.substitute or controller.substitute,
    )


def field_bridges(index: Index) -> dict[str, S7Bridge | ModbusBridge]:
    """Return the bridges of a plant without findings, by their keys."""
    plant, served = index.plant, _Served(index, FindingReport(""))
    found: dict[str, S7Bridge | ModbusBridge] = {}
    if plant.s7 is not None:
        blocks = None if plant.s7.server is None else served.s7(plant.s7.server)
        found["s7"] = S7Bridge(plant.s7.controllers, blocks)
    if plant.modbus is not None:
        tables = None if plant.modbus.server is None else served.modbus(plant.modbus.server)
        found["modbus"] = ModbusBridge(plant.modbus.controllers, tables)
    return found


def field_bridge_on(bridge: Struct, is_served: Callable[[str], bool]) -> Struct:
    """Return a bridge as it runs on one host: without a server that listens on another one."""
    if isinstance(bridge, S7Bridge | ModbusBridge):
        server = bridge.server
        if server is not None and not is_served(server.listen):
            return replace(bridge, server=None)
    return bridge


def served_point(item: ServedItem, server: FieldServer) -> FieldPoint:
    """Return the place and type of a variable that is served."""
    kind = datatypes.parse(item.kind)
    if item.address.partition(":")[0] not in set(ModbusTable):
        return s7_point(kind, item.address, item.type)
    return modbus_point(
        kind,
        item.address,
        item.type,
        words_swapped=server.words_swapped,
        bytes_swapped=server.bytes_swapped,
    )
