"""Routes of running stations, and the text of StaticRoutes files."""

from __future__ import annotations

import codecs
import re
from typing import NamedTuple, Self

import msgspec

from eap.control.protocol import Document
from eap.control.routes import ROUTES_LIST, RouterRow, TestResult
from eap.ops.client import ControlClient, connect

_DECLARED = re.compile(rb"""<\?xml[^>]*\sencoding\s*=\s*["']([A-Za-z0-9._-]+)["']""")
_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)


class RouterList(msgspec.Struct, frozen=True):
    """``eapctl routes list``."""

    stations: list[RouterRow]


class TestedTarget(Document, frozen=True, kw_only=True):
    """``eapctl routes test``: station that tested a target, and the fields of a TestResult."""

    __test__ = False

    station: str
    target: str
    name: str
    ok: bool
    rtt_us: int | None
    state: str
    error: int
    text: str
    hint: str

    @classmethod
    def of(cls, station: str, result: TestResult) -> Self:
        """Return the *result* of a test by *station*."""
        return cls(station=station, **msgspec.structs.asdict(result))


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
        match: What name, NetID, transport, address, origin or state of a route have in them.
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
    client: ControlClient, station: str, match: str, requests: int, most: int | None
) -> list[RouterRow]:
    """Return the routes of one appliance, page by page."""
    whole = []
    for each in client.call(ROUTES_LIST, station=station, match=match, requests=requests):
        rows = list(each.routes)
        while len(rows) < (each.total if most is None else min(most, each.total)):
            (more,) = client.call(
                ROUTES_LIST, station=each.station, match=match, first=len(rows), requests=0
            )
            if not more.routes:  # some went away meanwhile
                break
            rows += more.routes
        whole.append(msgspec.structs.replace(each, routes=rows[:most]))
    return whole


def text_of_xml(octets: bytes) -> str:
    """Return what a file of XML holds, in the encoding that it begins with or declares.

    Raises:
        ValueError: it is in another encoding, or in an unknown one.
    """
    for mark, encoding in _MARKS:
        if octets.startswith(mark):
            return octets.decode(encoding)
    declared = _DECLARED.match(octets)
    try:
        return octets.decode(declared[1].decode() if declared else "utf-8")
    except LookupError as exc:
        raise ValueError(str(exc)) from None
