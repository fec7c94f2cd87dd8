"""Link state of the interfaces that transports of this process depend on."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from eap.net.ethernet import EthernetInterface
from eap.net.interface import link_is_up
from eap.net.ipsocket import AddressKeeper
from eap.services.routing.station_router import StationRouter

LINK_POLL_S = 0.2
"""Interval between two polls of the links."""


class LinkWatch:
    """Link state of the interfaces: a pulled cable takes the hops of their transports down.

    Interfaces that were deleted and made again are joined again.

    Args:
        is_up: Returns whether the link of an interface is up.

    Attributes:
        addresses: What sockets have at the interfaces of local addresses.
    """

    def __init__(self, is_up: Callable[[str], bool] = link_is_up) -> None:
        self.addresses = AddressKeeper(self._notify)
        self._interfaces: list[EthernetInterface] = []
        self._transports: dict[str, list[tuple[StationRouter, str]]] = {}
        self._is_up = is_up
        self._down: set[str] = set()
        self._added = asyncio.Event()

    def add(self, interface: str, router: StationRouter, transport: str) -> None:
        """Watch *interface* for one transport of *router*."""
        self._transports.setdefault(interface, []).append((router, transport))
        if interface in self._down:
            router.hop_down(transport, None, _no_link(interface))
        self._notify()

    def remove(self, router: StationRouter, transport: str) -> None:
        """Watch no interface for a transport any more."""
        for interface, watched in list(self._transports.items()):
            watched[:] = [each for each in watched if each != (router, transport)]
            if not watched:
                del self._transports[interface]
                self._down.discard(interface)

    def find_again(self, interface: EthernetInterface) -> None:
        """Look for *interface* by its name while it is lost."""
        self._interfaces.append(interface)
        self._notify()

    def forget(self, interface: EthernetInterface) -> None:
        """Look for *interface* no more."""
        self._interfaces.remove(interface)

    async def serve(self) -> None:
        """Poll until cancelled, while there is any interface."""
        while True:
            if self._transports or self._interfaces or not self.addresses.is_empty:
                self.poll()
                await asyncio.sleep(LINK_POLL_S)
            else:
                self._added.clear()
                await self._added.wait()

    def poll(self) -> None:
        """Join interfaces that were made again; notify the routers of changed links."""
        self.addresses.look()
        for ethernet in self._interfaces:
            ethernet.find()
        for interface, transports in self._transports.items():
            is_up, was_up = self._is_up(interface), interface not in self._down
            if is_up and not was_up:
                self._down.discard(interface)
                for station, transport in transports:
                    station.hop_up(transport, None)
            elif was_up and not is_up:
                self._down.add(interface)
                for station, transport in transports:
                    station.hop_down(transport, None, _no_link(interface))

    def _notify(self) -> None:
        self._added.set()


def _no_link(interface: str) -> str:
    return f"interface {interface} has no link"
