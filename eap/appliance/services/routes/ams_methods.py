"""What the control protocol can be asked for about AMS: ways, who is behind them, and requests."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from eap.aoe.directory import AmsAddress, Directory
from eap.appliance import control_ams as words
from eap.appliance.control import ErrorCode, of_station, parameters
from eap.appliance.control_bus import to_octets
from eap.appliance.services.routes.scanning import scan, stations_of
from eap.appliance.services.routes.tracing import Traced, trace
from eap.appliance.services.routing.station_router import StationRouter
from eap.codec.ads import AdsError
from eap.errors import ControlError

_NS_PER_US = 1000


class AmsMethods:
    """Answers by the routers of all stations of the appliance.

    Args:
        routers: By station.
        directory: Names of the plant.
        addresses: Where each station is reached by AMS/TCP, if it is.
    """

    def __init__(
        self,
        routers: Mapping[str, StationRouter],
        directory: Directory,
        addresses: Mapping[str, str],
    ) -> None:
        self._routers = routers
        self._directory = directory
        self._addresses = addresses

    def table(self) -> dict[str, Callable[[dict[str, Any]], Any]]:
        """Return the methods by name; all have to be waited for.

        Raises:
            ControlError: (every method) there is no such station or target.
        """
        return {"scan": self._scan, "trace": self._trace, "ams_ask": self._ask}

    async def _scan(self, params: dict[str, Any]) -> dict[str, Any]:
        router = self._router(parameters(params, words.ScanParameters).via)
        rows = await scan(router, stations_of(self._directory, router.table))
        via = {"station": router.name, "address": self._addresses.get(router.name, "")}
        return {"stations": rows, "via": via}

    async def _trace(self, params: dict[str, Any]) -> dict[str, Any]:
        wanted = parameters(params, words.TraceParameters)
        router, address = self._router(wanted.via), _found(self._directory.find, wanted.target)
        found = await trace(router, *address)
        return {
            "target": wanted.target,
            "address": str(address),
            "name": self._directory.name_of(*address),
            "ok": not found.why,
            "why": found.why,
            "hops": _hop_rows(found),
            "answer": _answer_row(found),
        }

    async def _ask(self, params: dict[str, Any]) -> dict[str, Any]:
        wanted = parameters(params, words.AskParameters)
        find = self._directory.find_device if wanted.device else self._directory.find
        router, address = self._router(wanted.via), _found(find, wanted.target)
        timeout_s = wanted.timeout_ms / 1000
        data = to_octets(wanted.data)
        answer = await router.ask(*address, wanted.command, data, timeout_s=timeout_s)
        return {"error": answer.error_code, "data": answer.data.hex()}

    def _router(self, via: str) -> StationRouter:
        return of_station(via or next(iter(self._routers)), self._routers)


def _found(find: Callable[[str], AmsAddress], target: str) -> AmsAddress:
    try:
        return find(target)
    except ValueError as exc:
        raise _unknown(str(exc)) from None


def _hop_rows(found: Traced) -> list[dict[str, Any]]:
    rows, before_us = [], 0
    for hop in found.hops:
        took_us = hop.took_ns // _NS_PER_US
        spent_us = max(0, took_us - before_us)
        rows.append(words.hop_row(hop.report, took_us, spent_us, is_opaque=hop.is_opaque))
        before_us = took_us
    return rows


def _answer_row(found: Traced) -> dict[str, Any] | None:
    if found.answer is None:
        return None
    states = found.states
    return {
        "error": found.answer.result,
        "text": AdsError.words_of(found.answer.result) if found.answer.result else "",
        "ads_state": states and states.ads_state,
        "device_state": states and states.device_state,
        "took_us": found.took_ns // _NS_PER_US,
    }


def _unknown(reason: str) -> ControlError:
    return ControlError(reason, code=ErrorCode.UNKNOWN_NAME)
