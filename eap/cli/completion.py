"""Completion of names by the shell: plants, stations, ports, slaves and variables that run here.

The names come from the process images, so that no process of an appliance is asked.  A name that
cannot be found out is no error: the shell then has nothing to offer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, TypeAlias

import click

from eap.errors import EapError

if TYPE_CHECKING:
    from eap.pd.layout import ImageLayout

Completion: TypeAlias = Callable[[click.Context, click.Parameter, str], list[str]]


def complete_plant(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    """Return the running plants that begin with *incomplete*."""
    del ctx, param
    from eap.runtime.folder import find_running

    return _beginning(incomplete, (info.plant for _, info in find_running()))


def complete_station(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    """Return the running stations that begin with *incomplete*."""
    del ctx, param
    return _beginning(incomplete, _stations())


def complete_target(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    """Return stations, and behind a slash their ports."""
    del ctx, param
    names = _ports(incomplete) if "/" in incomplete else _stations()
    return _beginning(incomplete, names)


def complete_bus(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    """Return the bus ports of all stations."""
    del ctx, param
    from eap.pd.spec import PortKind

    return _beginning(
        incomplete,
        (
            f"{layout.station}/{port.name}"
            for layout in _layouts()
            for port in layout.ports
            if port.kind == PortKind.BUS
        ),
    )


def complete_variables(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    """Return variables: those of the station that was named before, else ``STATION/VARIABLE``.

    Without a slash a first word is completed to a station.
    """
    given = ctx.params.get(str(param.name)) or ctx.params.get("source") or ()
    words = (given,) if isinstance(given, str) else tuple(given)
    station = words[0] if words and "/" not in words[0] else ""
    if "/" in incomplete:
        names = (
            f"{layout.station}/{slot.name}"
            for layout in _layouts(incomplete.partition("/")[0])
            for slot in layout.variables
        )
    elif station:
        names = (slot.name for layout in _layouts(station) for slot in layout.variables)
    else:
        return _beginning(incomplete, _stations())
    return _beginning(incomplete, names)


def _beginning(incomplete: str, names: Iterable[str]) -> list[str]:
    try:
        return sorted({name for name in names if name.startswith(incomplete)})
    except (EapError, OSError):
        return []


def _stations() -> Iterator[str]:
    from eap.runtime.folder import find_running

    for _, info in find_running():
        yield from info.stations


def _ports(incomplete: str) -> Iterator[str]:
    for layout in _layouts(incomplete.partition("/")[0]):
        yield from (f"{layout.station}/{port.name}" for port in layout.ports)
        yield f"{layout.station}/router"


def _layouts(station: str = "") -> Iterator[ImageLayout]:
    """Yield the layouts of the images of all running stations, or of one *station*."""
    from eap.net.image_file import open_image
    from eap.runtime.folder import find_running

    for folder, info in find_running():
        for name in info.stations:
            if station in {"", name}:
                with open_image(folder.image(name)) as file:
                    yield file.image.layout
