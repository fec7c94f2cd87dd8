"""The methods about routes of an appliance whose routers a test makes up."""

from __future__ import annotations

from typing import Any

import msgspec

from eap.control.protocol import ErrorCode, parameters
from eap.control.routes import (
    ConnectionRow,
    Export,
    ImportRow,
    RequestRow,
    RouteRow,
    RouterRow,
    RoutesAddParameters,
    RoutesExportParameters,
    RoutesImportParameters,
    RoutesListParameters,
    RoutesRemoveParameters,
    RoutesTestParameters,
    TestResult,
)
from eap.errors import ControlError
from tests.support.controlstub import Method

ISLAND = RouteRow(
    name="island-02", net_id="127.0.1.2.1.1", octets=4, transport="udp:eap0",
    address="127.0.1.2:34980", origin="derived",
    state="up", rtt_us=840, requests=12, answers=12, octets_out=1_234,
    octets_in=45_678,
)  # fmt: skip
PRESS = RouteRow(
    name="press", net_id="5.1.2.3.1.1", octets=6, transport="ams-tcp", address="192.168.1.5:48898",
    origin="added", state="down", why="connection refused", requests=3, errors=3,
    last_error="press (192.168.1.5:48898 by ams-tcp): connection refused",
)  # fmt: skip
CLIENT = RouteRow(
    name="laptop", net_id="192.168.1.9.1.1", octets=4, transport="ams-tcp",
    address="192.168.1.9:48898", origin="added",
    state="client", why="not listening: connection refused", probed=False,
)  # fmt: skip
TOOL = ConnectionRow(
    transport="ams-tcp", address="127.0.0.1:40112#3", since_s=75, net_ids=["127.0.0.1.1.1"],
    requests=15, answers=15, errors=3, octets_out=45_900, octets_in=1_400, took_us=900,
    last_error="press is down",
)  # fmt: skip
READ = RequestRow(
    at=1_795_275_549.9, outcome="answered", service="READ", target="127.0.1.2.2.1:65535",
    source="127.0.0.1.1.1:32905", came_by="127.0.0.1:40112#3 by ams-tcp", transport="udp:eap0",
    address="127.0.1.2:34980", took_us=1_200,
)  # fmt: skip
REFUSED = RequestRow(
    at=1_795_275_550.9, outcome="failed", service="READ", target="5.1.2.3.1.1:851",
    source="127.0.0.1.1.1:32905", came_by="127.0.0.1:40112#3 by ams-tcp", transport="ams-tcp",
    address="192.168.1.5:48898", error=0x1B, text="press is down",
)  # fmt: skip
SHADOW = "route press (5.1.2.3.1.1) is not taken: plc (5.1.2.3.1.1) is before it"


class FakeRoutes:
    """Routers of stations, by name; they do what they are told and send nothing."""

    def __init__(self) -> None:
        self.stations = {
            "island-01": RouterRow(
                station="island-01", net_id="127.0.1.1.1.1", routes=[ISLAND, PRESS], total=2,
                connections=[TOOL], requests=[READ, REFUSED], warnings=[SHADOW],
            ),
            "island-02": RouterRow(
                station="island-02", net_id="127.0.1.2.1.1", routes=[], total=0
            ),
        }  # fmt: skip
        self.page = 1000

    def table(self) -> dict[str, Method]:
        return {
            "routes_list": self._list,
            "routes_add": self._add,
            "routes_remove": self._remove,
            "routes_test": self._test,
            "routes_import": self._import,
            "routes_export": self._export,
        }

    def set_routes(self, station: str, *routes: RouteRow) -> None:
        self.stations[station] = msgspec.structs.replace(
            self.stations[station], routes=list(routes), total=len(routes)
        )

    def _list(self, params: dict[str, Any]) -> list[RouterRow]:
        wanted = parameters(params, RoutesListParameters)
        found = []
        for each in self.stations.values():
            if wanted.station in {"", each.station}:
                rows = [row for row in each.routes if wanted.match in f"{row.name} {row.net_id}"]
                page = rows[wanted.first : wanted.first + min(wanted.count, self.page)]
                requests = each.requests[: wanted.requests]
                found.append(
                    msgspec.structs.replace(each, routes=page, total=len(rows), requests=requests)
                )
        return found

    def _add(self, params: dict[str, Any]) -> dict[str, Any]:
        wanted = parameters(params, RoutesAddParameters)
        transport, _, address = wanted.via.partition(":")
        if not address:
            reason = f"via {wanted.via!r} is no port of the plant"
            raise ControlError(reason, code=ErrorCode.VALUE)
        row = RouteRow(
            name=wanted.name, net_id=wanted.net_id, octets=wanted.octets, transport=transport,
            address=address, origin="added", state="unknown", unidirectional=wanted.unidirectional,
            timeout_ms=wanted.timeout_ms, probed=wanted.probed, real=wanted.virtual,
        )  # fmt: skip
        rows = self.stations[wanted.station].routes
        kept = [each for each in rows if wanted.replaces not in {each.name, each.net_id}]
        self.set_routes(wanted.station, *kept, row)
        warnings = [f"route {row.name} is never taken"] if row.name == "shadow" else []
        return {"route": msgspec.to_builtins(row), "warnings": warnings}

    def _remove(self, params: dict[str, Any]) -> dict[str, Any]:
        wanted = parameters(params, RoutesRemoveParameters)
        rows = self.stations[wanted.station].routes
        for row in rows:
            if wanted.route in {row.name, row.net_id}:
                if row.origin == "derived":
                    reason = f"route {row.name} follows from the plant file"
                    raise ControlError(reason, code=ErrorCode.REFUSED)
                self.set_routes(wanted.station, *(each for each in rows if each is not row))
                return {"route": msgspec.to_builtins(row)}
        raise ControlError(f"no route {wanted.route!r}", code=ErrorCode.UNKNOWN_NAME)

    def _test(self, params: dict[str, Any]) -> TestResult:
        wanted = parameters(params, RoutesTestParameters)
        for row in self.stations[wanted.station].routes:
            if wanted.target in {row.name, row.net_id}:
                target = f"{row.net_id}:10000"
                if row.state in {"down", "client"}:
                    return TestResult(
                        target=target, name=row.name, ok=False, error=0x1B,
                        text=f"down: {row.why}", hint="see whether it is switched on",
                    )  # fmt: skip
                return TestResult(
                    target=target, name=row.name, ok=True, rtt_us=row.rtt_us, state="RUN",
                    text="answers: RUN",
                )  # fmt: skip
        raise ControlError(f"no route {wanted.target!r}", code=ErrorCode.UNKNOWN_NAME)

    def _import(self, params: dict[str, Any]) -> list[ImportRow]:
        wanted = parameters(params, RoutesImportParameters)
        if "bad" in wanted.xml:
            reason = "type 'PROFIBUS', expected TCP_IP"
            return [ImportRow(name="bad", net_id="1.1.1.1.1.1", via="", reason=reason)]
        return [ImportRow(name="press", net_id="5.1.2.3.1.1", via="ams-tcp:192.168.1.5")]

    def _export(self, params: dict[str, Any]) -> Export:
        station = parameters(params, RoutesExportParameters).station
        return Export(xml=f"<TcConfig>{station}</TcConfig>\n", left_out=["island-02"])
