"""The text of a new plant file: stations in a ring or a star, with everything allocated.

The text has comments for its readers, passes the checks and runs unchanged.  Example plants come
with the package: plant files, and the files that they refer to.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from enum import StrEnum
from ipaddress import IPv4Address
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import msgspec

from eap.errors import ConfigError
from eap.ids import InterfaceUri, is_host
from eap.suggest import suggest

MIN_STATIONS = 2
MAX_STATIONS = 250
DEFAULT_ADDRESS = "127.0.1.{n}"
NUMBER = "{n}"
"""Placeholder for the number of a station, from 1 on."""
_STATE_ID = 1000
_COMMAND_ID = 2000
_MIN_TIMEOUT_MS = 50
_SHOWN = 5
"""Stations that a drawing shows."""
_NAME = re.compile(r"[^\s/]+")
_PLAIN = re.compile(r"(?!(?:true|false|null)$)[A-Za-z][\w-]*", re.ASCII | re.IGNORECASE)
"""Texts that YAML reads as they are."""
_INTERFACE = re.compile(r"[\w.@-]{1,15}", re.ASCII)


SCHEMA = Path(__file__).resolve().with_name("plant.schema.json")
"""JSON Schema of plant files, written by ``python -m tools.schema``."""
SCHEMA_LINE = f"# yaml-language-server: $schema={SCHEMA.as_uri()}"
"""Comment by which editors find the schema."""


class Shape(StrEnum):
    """Direction of process data between stations."""

    RING = "ring"
    """Each station sends to the next one."""
    STAR = "star"
    """The first station sends to all others, and they to the first."""


class NewPlant(msgspec.Struct, frozen=True):
    """``eapctl new``: file, and number of stations."""

    file: str
    plant: str
    shape: str
    stations: int


class _StationAddress(NamedTuple):
    """One station's name and addresses."""

    number: int
    name: str
    interface: str
    net_id: str
    """Without the last two bytes: 1.1 is the router's, 2.1 that of the port."""


def plant_text(
    name: str,
    count: int,
    shape: Shape,
    *,
    address: str = DEFAULT_ADDRESS,
    cycle_us: int = 10_000,
    file: str = "FILE",
) -> str:
    """Return a plant file of *count* stations.

    Args:
        name: The plant's.
        count: Of stations, 2 to 250.
        shape: Direction of process data between stations.
        address: An IPv4 address or an interface; ``{n}`` in it is the station's number, and an
            IPv4 address without it is that of the first station, the others follow.
        cycle_us: Device cycle.
        file: Name of the file, for the commands in its comments.

    Raises:
        ConfigError: the name, the number of stations or the address is invalid.
    """
    line = plant_line(name)
    if not MIN_STATIONS <= count <= MAX_STATIONS:
        raise ConfigError(
            f"{count} stations: a {shape} has {MIN_STATIONS} to {MAX_STATIONS} of them"
        )
    places = [_place(number, address, count) for number in range(1, count + 1)]
    draw, stations = (_ring_drawing, _ring) if shape is Shape.RING else (_star_drawing, _star)
    return "\n".join(
        [
            SCHEMA_LINE,
            *_head(name, shape, places),
            *(f"#   {line}" for line in draw(places)),
            *_usage(places, file),
            line,
            f"defaults: {{cycle_us: {cycle_us}}}",
            "",
            *_shared(shape, max(_MIN_TIMEOUT_MS, 5 * cycle_us // 1000)),
            "stations:",
            *stations(places),
        ]
    )


def plant_line(name: str) -> str:
    """Return the line of a plant file that has the plant's *name*; raise ConfigError if invalid."""
    if not _NAME.fullmatch(name):
        raise ConfigError(f"plant name {name!r}: expected a text without spaces and slashes")
    return f"plant: {name if _PLAIN.fullmatch(name) else json.dumps(name)}"


def _place(number: int, address: str, count: int) -> _StationAddress:
    text = address.replace(NUMBER, str(number))
    try:
        uri = InterfaceUri.parse(text if "://" in text else f"udp://{text}")
        if uri.scheme == "udp" and NUMBER not in address:
            uri = InterfaceUri(uri.scheme, str(IPv4Address(uri.host) + (number - 1)), uri.port)
    except ValueError as exc:
        raise ConfigError(f"address {address!r}: {exc}") from None
    if uri.scheme == "udp":
        if not is_host(uri.host):
            raise ConfigError(f"address {address!r}: {uri.host} is no address of a station")
        net_id = uri.host
    elif uri.scheme == "ethernet":
        if not _INTERFACE.fullmatch(uri.host):
            raise ConfigError(f"address {address!r}: {uri.host!r} is no interface name")
        net_id = f"10.88.164.{number}"
    else:
        raise ConfigError(
            f"address {address!r}: stations are made for udp and ethernet, such as"
            f" 10.0.0.{NUMBER} or ethernet://eth0"
        )
    width = max(2, len(str(count)))
    return _StationAddress(number, f"station-{number:0{width}}", str(uri), net_id)


def _head(name: str, shape: Shape, places: list[_StationAddress]) -> Iterator[str]:
    what = {
        Shape.RING: "each sends its state to the next one",
        Shape.STAR: f"{places[0].name} sends commands to all others, and they send it their states",
    }[shape]
    yield f"# {name}: {len(places)} stations in a {shape}, {what}."
    yield "#"


def _ring_drawing(places: list[_StationAddress]) -> Iterator[str]:
    names = [place.name for place in places]
    if len(names) > _SHOWN:
        names = [*names[:2], "…", names[-1]]
    yield " ──► ".join([*names, names[0]])


def _star_drawing(places: list[_StationAddress]) -> Iterator[str]:
    hub, *others = (place.name for place in places)
    shown = others if len(others) <= _SHOWN else [others[0], "…", others[-1]]
    for row, other in enumerate(shown):
        yield f"{hub if row == 0 else '':{len(hub)}} ◄──► {other}"


def _usage(places: list[_StationAddress], file: str) -> Iterator[str]:
    first, second = places[0], places[1]
    yield "#"
    if first.interface.startswith("ethernet://"):
        yield "# Each station runs on a host of its own and needs CAP_NET_RAW there:"
        yield f"#   eapctl run {file} --station {first.name}"
        yield "# Stations send as soon as they run: check that the interface is the one you mean."
    else:
        yield "# Run all stations here, or one with --station NAME on each host:"
        yield f"#   eapctl run {file}"
    yield "# and, in a second terminal:"
    yield "#   eapctl status"
    yield f"#   eapctl pd watch {second.name}"
    yield f"#   eapctl pd set {first.name} setpoint 75"
    yield "# To change the plant while it runs, edit this file, see what differs, and apply it:"
    yield f"#   eapctl plan {file}"
    yield f"#   eapctl apply {file}"


def _shared(shape: Shape, timeout_ms: int) -> Iterator[str]:
    frame = "to-next" if shape is Shape.RING else "to-hub"
    yield "# What every station has of its own.  Sources fill two of the variables until a program"
    yield "# of yours does; take the source away then."
    yield "x-station: &station"
    yield "  variables:"
    yield "    ticks: {type: UDINT, comment: device cycles}"
    yield "    temperature: {type: REAL, unit: degC, comment: a sine in place of a sensor}"
    yield "    running: {type: BOOL, default: true}"
    yield "    setpoint: {type: UINT, unit: 1/min, default: 50}"
    yield "  sources:"
    yield "    ticks: {kind: counter}"
    yield "    temperature: {kind: sine, offset: 180, amplitude: 5, period_ms: 10000}"
    yield ""
    yield "# What is sent, in each device cycle as no other trigger is named.  Raise the version"
    yield "# with each change of the variables, so that no subscriber reads them by the old one."
    yield (
        f"x-state: &state {{name: state, frame: {frame}, version: 1,"
        " variables: [ticks, temperature, running, setpoint]}"
    )
    if shape is Shape.STAR:
        yield "x-command: &command {version: 1, variables: [ticks, setpoint]}"
    yield f"# How it is received: after {timeout_ms} ms without news the values are zero."
    yield f"x-watched: &watched {{port: eap0, timeout_ms: {timeout_ms}, substitute: zero}}"
    yield ""


def _ring(places: list[_StationAddress]) -> Iterator[str]:
    for place, following in zip(places, [*places[1:], places[0]], strict=True):
        previous = places[place.number - 2]
        yield from _station(place)
        yield "    frames:"
        yield f"      - {{name: to-next, port: eap0, to: {_destination(following)}}}"
        yield "    publish:"
        yield f"      - {{<<: *state, id: {_STATE_ID + place.number}}}"
        yield "    subscribe:"
        yield f"      - {{<<: *watched, name: previous, from: {previous.name}/state}}"
        yield ""


def _star(places: list[_StationAddress]) -> Iterator[str]:
    hub, *others = places
    yield from _station(hub)
    yield "    frames:"
    for other in others:
        yield f"      - {{name: {_to(other)}, port: eap0, to: {_destination(other)}}}"
    yield "    publish:"
    for other in others:
        number = _COMMAND_ID + other.number
        yield f"      - {{<<: *command, name: {_to(other)}, frame: {_to(other)}, id: {number}}}"
    yield "    subscribe:"
    for other in others:
        yield f"      - {{<<: *watched, name: {other.name}, from: {other.name}/state}}"
    yield ""
    for other in others:
        yield from _station(other)
        yield "    frames:"
        yield f"      - {{name: to-hub, port: eap0, to: {_destination(hub)}}}"
        yield "    publish:"
        yield f"      - {{<<: *state, id: {_STATE_ID + other.number}}}"
        yield "    subscribe:"
        yield f"      - {{<<: *watched, name: hub, from: {hub.name}/{_to(other)}}}"
        yield ""


def _station(place: _StationAddress) -> Iterator[str]:
    yield "  - <<: *station"
    yield f"    name: {place.name}"
    yield f"    net_id: {place.net_id}.1.1"
    yield "    ports:"
    yield (
        f'      - {{name: eap0, kind: eap, interface: "{place.interface}",'
        f" net_id: {place.net_id}.2.1}}"
    )


def _destination(place: _StationAddress) -> str:
    """Return the destination of frames for *place*; the file has no MAC addresses."""
    return "multicast" if place.interface.startswith("ethernet://") else f"{place.name}/eap0"


def _to(place: _StationAddress) -> str:
    return f"to-{place.name.removeprefix('station-')}"


_PACKAGE = Path(__file__).resolve().parents[1]
_SOURCES = "config"
"""Folder of the examples in the project; in an installed package it is ``eap/examples``."""
_PATH = re.compile(r"(?:\.\./)*\w[\w-]*(?:[./]\w[\w-]*)+")
_PLANT_LINE = re.compile(r"^plant: .*$", re.MULTILINE)


class CopiedExample(msgspec.Struct, frozen=True):
    """``eapctl new --from``: the plant file, and the files beside it."""

    file: str
    plant: str
    example: str
    files: list[str]


def example_names() -> list[str]:
    """Return the names of all example plants."""
    return sorted(path.stem for path in _folder().glob("*.yaml"))


def read_example(example: str, plant: str, file: Path) -> dict[Path, bytes]:
    """Return the files of an example: the plant file first, all with their new paths.

    Args:
        example: Its name.
        plant: Name of the new plant.
        file: Path of the plant file; the others are put beside it, in folders of their own.

    Raises:
        ConfigError: there is no such example, or the name of the plant is invalid.
    """
    line = plant_line(plant)
    names = example_names()
    if example not in names:
        hint = suggest(example, names) or f"; known examples: {', '.join(names)}"
        raise ConfigError(f"unknown example {example!r}{hint}")
    source = _folder() / f"{example}.yaml"
    text = source.read_text()
    beside = file.parent.as_posix() + "/" if file.parent != Path() else ""
    written = text.replace(f"{_SOURCES}/{source.name}", str(file))
    written = written.replace(f"{_SOURCES}/", beside)
    written = _PLANT_LINE.sub(lambda _: line, written, count=1)
    found = {file: f"{SCHEMA_LINE}\n{written}".encode()}
    for path in _related(source):
        found[file.parent / path.relative_to(_folder())] = path.read_bytes()
    return found


def _folder() -> Path:
    installed = _PACKAGE / "examples"
    return installed if installed.is_dir() else _PACKAGE.parent / _SOURCES


def _related(source: Path) -> Iterator[Path]:
    """Yield the files that *source* names, and those that they name, each once."""
    seen = {source}
    waiting = [source]
    while waiting:
        path = waiting.pop()
        for name in _PATH.findall(path.read_text()):
            relative = PurePosixPath(name.removeprefix(f"{_SOURCES}/"))
            target = (path.parent / relative).resolve()
            found = sorted(target.iterdir()) if target.is_dir() else [target]
            for each in found:
                if each.is_file() and each.is_relative_to(_folder()) and each not in seen:
                    seen.add(each)
                    waiting.append(each)
                    yield each
