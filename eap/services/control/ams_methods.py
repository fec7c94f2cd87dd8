"""Methods of the control protocol that send AMS requests: scan, trace and single requests."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from eap.ams.directory import AmsAddress, Directory
from eap.codec.ads import AdsError
from eap.control import routes as words
from eap.control.bus import to_octets
from eap.control.protocol import ErrorCode, of_station
from eap.errors import ControlError
from eap.services.routing.scanning import scan, scan_targets
from eap.services.routing.station_router import StationRouter
from eap.services.routing.tracing import TraceResult, trace

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
        return dict(
            (
                words.SCAN.served_by(self._scan),
                words.TRACE.served_by(self._trace),
                words.AMS_ASK.served_by(self._ask),
            )
        )

    async def _scan(self, wanted: words.ScanParameters) -> words.PlantScan:
        router = self._router(wanted.via)
        stations = await scan(router, scan_targets(self._directory, router.table))
        via = words.ScanVia(router.name, self._addresses.get(router.name, ""))
        return words.PlantScan(stations, via)

    async def _trace(self, wanted: words.TraceParameters) -> words.TracedPath:
        router, address = self._router(wanted.via), _found(self._directory.find, wanted.target)
        found = await trace(router, *address)
        return words.TracedPath(
            wanted.target,
            str(address),
            self._directory.name_of(*address),
            not found.why,
            found.why,
            _hop_rows(found),
            _target_answer(found),
        )

    async def _ask(self, wanted: words.AskParameters) -> words.AmsReply:
        find = self._directory.find_device if wanted.device else self._directory.find
        router, address = self._router(wanted.via), _found(find, wanted.target)
        timeout_s = wanted.timeout_ms / 1000
        data = to_octets(wanted.data)
        answer = await router.request(*address, wanted.command, data, timeout_s=timeout_s)
        return words.AmsReply(answer.error_code, answer.data.hex())

    def _router(self, via: str) -> StationRouter:
        return of_station(via or next(iter(self._routers)), self._routers)


def _found(find: Callable[[str], AmsAddress], target: str) -> AmsAddress:
    try:
        return find(target)
    except ValueError as exc:
        raise _unknown(str(exc)) from None


def _hop_rows(found: TraceResult) -> list[words.HopRow]:
    rows, before_us = [], 0
    for hop in found.hops:
        took_us = hop.took_ns // _NS_PER_US
        spent_us = max(0, took_us - before_us)
        rows.append(words.hop_row(hop.report, took_us, spent_us, is_opaque=hop.is_opaque))
        before_us = took_us
    return rows


def _target_answer(found: TraceResult) -> words.TargetAnswer | None:
    if found.answer is None:
        return None
    states, result = found.states, found.answer.result
    return words.TargetAnswer(
        result,
        AdsError.words_of(result) if result else "",
        None if states is None else states.ads_state,
        None if states is None else states.device_state,
        found.took_ns // _NS_PER_US,
    )


def _unknown(reason: str) -> ControlError:
    return ControlError(reason, code=ErrorCode.UNKNOWN_NAME)
