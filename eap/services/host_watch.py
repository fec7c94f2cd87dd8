"""Watch over the other hosts of a plant: whether they answer, and which release they run.

Each is asked ``hello`` by ADS through the routers of this host, which is the handshake of the
control protocol: hosts one release apart work together, and ``status`` names the difference.
"""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from time import time
from typing import Any

import msgspec

from eap.ads.request import ReadWrite
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.ams import CONTROL_PORT
from eap.config.plant_sections import HostSection
from eap.control.by_ads import PART, AnswerPart, ControlOffset
from eap.control.protocol import HELLO, Hello, decode_reply, encode_request
from eap.errors import CodecError, ControlError
from eap.ids import NetId
from eap.release import RELEASE, are_neighbours
from eap.services.routing.station_router import StationRouter
from eap.services.routing.tracing import run_operation

PERIOD_S = 10.0
"""Time between two requests to a host."""
ANSWER_S = 3.0
"""Time for an answer."""


class HostState(msgspec.Struct, frozen=True):
    """Another host, as it answered last.

    Attributes:
        name: Its name.
        address: Its address in the plant file.
        release: Of its appliance; empty if unknown.
        reason: Reason that it does not answer; empty if it does, None if it was not asked yet.
        since: Unix time from which on that holds.
    """

    name: str
    address: str
    release: str = ""
    reason: str | None = None
    since: float | None = None


class HostWatch:
    """The other hosts of the plant.

    Args:
        own: Name of this host; empty for a plant of one host, which has nothing to watch.
        hosts: All hosts of the plant.
        net_ids: NetIDs of the routers of all stations of the plant, by name.
        routers: Of the stations of this host.
    """

    def __init__(
        self,
        own: str,
        hosts: Sequence[HostSection],
        net_ids: Mapping[str, NetId],
        routers: Mapping[str, StationRouter],
    ) -> None:
        self.own = own
        self._net_ids = net_ids
        self._routers = routers
        others = [host for host in hosts if own and host.name != own]
        self._stations = {host.name: host.stations for host in others}
        self._states = {host.name: HostState(host.name, host.address) for host in others}

    async def serve(self) -> None:
        """Ask the hosts, one after the other, until cancelled."""
        while self._states:
            for name in self._states:
                self._note(name, *await self._ask(name))
            await asyncio.sleep(PERIOD_S)

    def report(self) -> list[dict[str, Any]]:
        """Return the rows of ``status``."""
        return [msgspec.structs.asdict(each) for each in self._states.values()]

    def findings(self) -> list[dict[str, Any]]:
        """Return the releases that differ from that of this host, as findings of ``status``."""
        return [
            {
                "severity": "warning" if are_neighbours(each.release, RELEASE) else "error",
                "where": f"host {each.name}",
                "what": f"runs release {each.release}, this host {RELEASE}",
                "advice": (
                    "one release apart, which works: upgrade the older one"
                    if are_neighbours(each.release, RELEASE)
                    else "more than one release apart: upgrade the older one step by step"
                ),
                "since": each.since,
            }
            for each in self._states.values()
            if each.release not in {"", RELEASE}
        ]

    def _note(self, name: str, hello: Hello | None, reason: str) -> None:
        before = self._states[name]
        # A host that is away keeps its release: it is there again with the same, mostly.
        release = before.release if hello is None else hello.release
        if (before.release, before.reason) != (release, reason):
            self._states[name] = HostState(name, before.address, release, reason, time())

    async def _ask(self, name: str) -> tuple[Hello | None, str]:
        """Return the answer of a host, and the reason if there is none."""
        line = encode_request(1, HELLO.name, {}).rstrip(b"\n")
        operation = ReadWrite(IndexGroup.CONTROL, ControlOffset.REQUEST, PART, line)
        reason = "no station of this host has a route there"
        for station in self._stations[name]:
            for router in self._routers.values():
                outcome = await run_operation(
                    router, self._net_ids[station], CONTROL_PORT, operation, ANSWER_S
                )
                if outcome.result:
                    reason = AdsError.words_of(outcome.result)
                    continue
                try:
                    AnswerPart.decode(outcome.data)
                    reply = decode_reply(outcome.data[AnswerPart.SIZE :])
                    return HELLO.decode(reply.result), ""
                except (CodecError, ControlError) as exc:
                    return None, f"no answer of the control protocol: {exc}"
        return None, reason
