"""Addresses of variables in data blocks and registers: of servers and of controllers."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import Literal, TextIO, TypeAlias

import msgspec

from eap.codec import datatypes
from eap.codec.datatypes import find_variable
from eap.codec.fieldaddresses import FieldPoint, place_text
from eap.config.bridge_sections import ModbusBridge, S7Bridge
from eap.config.field import address_point, served_point
from eap.config.load import Plant
from eap.errors import ConfigError
from eap.pd.spec import FieldSource, StationSpec, Target, VariableSpec
from eap.runtime.plantfile import load_plant

_Key: TypeAlias = Literal["s7", "modbus"]
_Access: TypeAlias = Literal["read", "write", "source", "target"]


class AddressRow(msgspec.Struct, frozen=True, kw_only=True):
    """A variable at an address.

    Attributes:
        bridge: Protocol.
        at: ``server``, or the name of a controller.
        address: As in the plant file.
        type: Type there.
        bits: Its length.
        variable: ``STATION/VARIABLE``.
        access: Of a server ``read`` or ``write`` (also read); of a controller ``source`` (it is
            read there) or ``target`` (it is written there).
        unit: Unit of the variable.
        comment: Comment of the variable.
    """

    bridge: _Key
    at: str
    address: str
    type: str
    bits: int
    variable: str
    access: _Access
    unit: str = ""
    comment: str = ""


def list_addresses(path: Path) -> list[AddressRow]:
    """Return the addresses that the plant file at *path* has or computes, servers first.

    Raises:
        ConfigError: the plant file has an error.
    """
    result = load_plant(path)
    if result.plant is None:
        raise ConfigError("\n".join(map(str, result.findings)))
    return [*_served(result.plant), *_in_controllers(result.plant)]


def write_addresses(rows: list[AddressRow], file: TextIO) -> None:
    """Write *rows* as CSV with a line of names, for the engineer of a panel."""
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(AddressRow.__struct_fields__)
    writer.writerows(msgspec.structs.astuple(row) for row in rows)


def _served(plant: Plant) -> Iterator[AddressRow]:
    stations = {station.name: station for station in plant.stations}
    for key, section in _field(plant):
        if section.server is None:
            continue
        for item in section.server.items:
            station, _, variable = item.name.partition("/")
            point = served_point(item, section.server)
            access: _Access = "write" if item.write else "read"
            yield _row(key, "server", point, stations[station], variable, access)


def _in_controllers(plant: Plant) -> Iterator[AddressRow]:
    for key, section in _field(plant):
        for station in plant.stations:
            sources = [each for each in station.sources if isinstance(each, FieldSource)]
            for each in (*sources, *station.targets):
                controller = section.controllers.get(each.controller)
                if controller is None:
                    continue
                kind = _find(station, each.variable)[1]
                point = address_point(kind, each.address, each.type, controller)
                access: _Access = "target" if isinstance(each, Target) else "source"
                yield _row(key, each.controller, point, station, each.variable, access)


def _field(plant: Plant) -> Iterator[tuple[_Key, S7Bridge | ModbusBridge]]:
    for section in plant.bridges.values():
        if isinstance(section, S7Bridge):
            yield "s7", section
        elif isinstance(section, ModbusBridge):
            yield "modbus", section


def _row(
    bridge: _Key, at: str, point: FieldPoint, station: StationSpec, name: str, access: _Access
) -> AddressRow:
    variable, _ = _find(station, name)
    return AddressRow(
        bridge=bridge,
        at=at,
        address=place_text(point),
        type=point.type.text,
        bits=point.type.bits,
        variable=f"{station.name}/{name}",
        access=access,
        unit=variable.unit,
        comment=variable.comment,
    )


def _find(station: StationSpec, name: str) -> tuple[VariableSpec, datatypes.DataType]:
    """Return the variable that *name* is or lies in, and the type of *name*."""
    specs = {each.name: each for each in station.variables}

    def type_of(variable: str) -> datatypes.DataType | None:
        spec = specs.get(variable)
        return None if spec is None else datatypes.parse(spec.type)

    found = find_variable(name, type_of)
    if found is None:  # the checks of the plant file have found it
        raise LookupError(name)
    return specs[found[0]], found[1].kind
