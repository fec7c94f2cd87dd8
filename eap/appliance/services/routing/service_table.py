"""Who answers for which NetID of a station, and at which AMS ports."""

from __future__ import annotations

from collections.abc import Collection, Container, Iterable
from time import monotonic_ns

from eap.aoe.answer import AmsAnswer
from eap.aoe.way import Way
from eap.appliance.services.routing.service import AnswerNow, Service
from eap.codec.ams import AmsHeader
from eap.ids import NetId


class ServiceTable:
    """The services of one station.

    Args:
        net_ids: All NetIDs that the station has.
    """

    def __init__(self, net_ids: Iterable[NetId]) -> None:
        self._services: dict[NetId, list[Service]] = {each: [] for each in net_ids}

    @property
    def net_ids(self) -> Collection[NetId]:
        """All NetIDs of the station."""
        return self._services.keys()

    def add(self, net_id: NetId, service: Service) -> None:
        """Let *service* answer for *net_id*; raise KeyError if the station has no such NetID."""
        self._services[net_id].append(service)

    def ports(self, net_id: NetId) -> Container[int]:
        """Return the AMS ports behind *net_id*, which may change at any time."""
        return _Ports(self._services[net_id])

    def find(self, header: AmsHeader) -> Service | None:
        """Return the first that has the port which a request is for."""
        for service in self._services[header.target]:
            if header.target_port in service.ports:
                return service
        return None

    def answer_now(self, header: AmsHeader, body: bytes) -> tuple[AmsAnswer, int] | None:
        """Return what a service has at hand for a request, and how many nanoseconds that took."""
        answer_now: AnswerNow | None = getattr(self.find(header), "answer_now", None)
        if answer_now is None:
            return None
        began_ns = monotonic_ns()
        try:
            answer = answer_now(header, body)
        except Exception:  # noqa: BLE001  it is logged when it fails again, in its lane
            return None
        return None if answer is None else (answer, monotonic_ns() - began_ns)

    def client_gone(self, way: Way) -> None:
        """Tell all of them that a connection is closed."""
        for services in self._services.values():
            for service in services:
                service.client_gone(way)


class _Ports:
    """The AMS ports that some services have now."""

    def __init__(self, services: Collection[Service]) -> None:
        self._services = services

    def __contains__(self, port: object) -> bool:
        for service in self._services:  # noqa: SIM110  any() takes twice as long
            if port in service.ports:
                return True
        return False
