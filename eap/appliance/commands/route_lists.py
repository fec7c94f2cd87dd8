"""The routes of running stations, as a command sees them."""

from __future__ import annotations

import codecs
import re
from typing import NamedTuple

import msgspec

from eap.appliance.commands.client import Client, connect
from eap.appliance.control_routes import RouterRow, read_document

_DECLARED = re.compile(rb"""<\?xml[^>]*\sencoding\s*=\s*["']([A-Za-z0-9._-]+)["']""")
_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)


class PlantRoutes(NamedTuple):
    """The routers of one running appliance."""

    plant: str
    stations: list[RouterRow]


def list_routes(
    plant: str | None,
    station: str | None,
    match: str = "",
    *,
    requests: int = 0,
    most: int | None = None,
) -> list[PlantRoutes]:
    """Return all routes of the running stations, or of *station*, that *match*.

    Args:
        plant: Of the appliance; None for all.
        station: Its name; None for all.
        match: What name, NetID, door, address, origin or state of a route have in them.
        requests: How many of the latest ones to return of each station.
        most: Routes of one station; None for as many as there are.

    Raises:
        ControlError: there is no such appliance or station, or it does not answer.
    """
    clients = connect(plant, station)
    try:
        return [
            PlantRoutes(each.info.plant, _ask(each, station or "", match, requests, most))
            for each in clients
        ]
    finally:
        for each in clients:
            each.close()


def _ask(
    client: Client, station: str, match: str, requests: int, most: int | None
) -> list[RouterRow]:
    """Return the routes of one appliance, page by page."""
    params = {"station": station, "match": match}
    answer = client.request("routes_list", **params, requests=requests)
    whole = []
    for each in read_document(answer, list[RouterRow]):
        rows = list(each.routes)
        while len(rows) < (each.total if most is None else min(most, each.total)):
            page = client.request(
                "routes_list", station=each.station, match=match, first=len(rows), requests=0
            )
            (more,) = read_document(page, list[RouterRow])
            if not more.routes:  # some went away meanwhile
                break
            rows += more.routes
        whole.append(msgspec.structs.replace(each, routes=rows[:most]))
    return whole


def text_of_xml(octets: bytes) -> str:
    """Return what a file of XML holds, in the encoding that it begins with or declares.

    Raises:
        ValueError: it is in another encoding, or in one that nobody knows.
    """
    for mark, encoding in _MARKS:
        if octets.startswith(mark):
            return octets.decode(encoding)
    declared = _DECLARED.match(octets)
    try:
        return octets.decode(declared[1].decode() if declared else "utf-8")
    except LookupError as exc:
        raise ValueError(str(exc)) from None
