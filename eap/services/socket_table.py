"""Open sockets of the ports of all stations, which follow their specifications.

Rule 1: the supervisor opens what a change needs before the change is stored.  What cannot be opened
refuses it, and nothing has changed.
Rule 2: a socket that no port needs any more is closed in the engine first, then here, and in the
supervisor last: each process may use it as long as the one before does.
"""

from __future__ import annotations

import asyncio
import os
import socket
from collections.abc import Awaitable, Callable

from eap.errors import EngineGoneError
from eap.pd.handover import PORT_CONTENT, PortChanges, port_changes
from eap.pd.spec import PortKind, PortSpec, StationSpec
from eap.runtime.handover import NO_DESCRIPTOR, Handover, PortName, SharedSocket, SocketKind
from eap.runtime.passing import pass_socket
from eap.runtime.socket_plan import plan_sockets, sockets_of
from eap.services.supervisor_link import SupervisorLink

Follow = Callable[[StationSpec, PortChanges], Awaitable[object]]
"""Called with a station and the changes of its EAP ports, once the engine has made them."""


class SocketTable:
    """Sockets of this process, and descriptors of those of the engine.

    Args:
        handover: Stations and sockets that the process was started with.
        supervisor: Opens and closes sockets.
        engine: Link to the engine, for its sockets.

    Attributes:
        on_change: Called in their order after ports of a station have changed.
    """

    def __init__(
        self, handover: Handover, supervisor: SupervisorLink, engine: socket.socket
    ) -> None:
        self._supervisor = supervisor
        self._engine = engine
        self._stations = {station.name: station for station in handover.stations}
        self._open = {each.key: each for each in handover.sockets}
        self._changing = asyncio.Lock()
        self.on_change: list[Follow] = []

    @property
    def stations(self) -> tuple[StationSpec, ...]:
        """All stations, as far as their ports are concerned."""
        return tuple(self._stations.values())

    @property
    def sockets(self) -> tuple[SharedSocket, ...]:
        """The sockets that the ports need, with their owners and descriptors."""
        planned = plan_sockets(self._stations.values())
        return tuple(_with_descriptors(each, self._open[each.key]) for each in planned)

    def station(self, name: str) -> StationSpec:
        """Return the specification of one station, as far as its ports are concerned."""
        return self._stations[name]

    def port(self, name: PortName) -> PortSpec:
        """Return the specification of one port."""
        ports = self._stations[name.station].ports
        return next(port for port in ports if port.name == name.port)

    def ams_address(self, station: str) -> str:
        """Return the first address at which AMS/TCP serves *station*, empty if there is none."""
        for shared in self.sockets:
            is_served = any(owner.station == station for owner in shared.owners)
            if shared.kind is SocketKind.AMS_TCP and is_served:
                return shared.address
        return ""

    def close(self) -> None:
        """Close all descriptors."""
        for opened in self._open.values():
            _close(opened)
        self._open.clear()

    def pass_to_engine(self, spec: StationSpec) -> None:
        """Pass the engine all of its sockets for the ports of *spec*; those it has do no harm.

        Raises:
            EngineGoneError: it takes none.
        """
        for port in spec.ports:
            for key in sockets_of(port) if port.kind is PortKind.EAP else ():
                opened = self._open.get(key)
                if opened is None or opened.engine_fd == NO_DESCRIPTOR:
                    continue
                with socket.socket(fileno=os.dup(opened.engine_fd)) as sock:
                    if not pass_socket(self._engine, key, sock):
                        raise EngineGoneError("the engine takes no sockets")

    def has_other_sockets(self, spec: StationSpec) -> bool:
        """Return whether a change to *spec* opens or closes sockets, or changes their owners."""
        return self._plan_with(spec) != plan_sockets(self._stations.values())

    def _plan_with(self, spec: StationSpec) -> tuple[SharedSocket, ...]:
        return plan_sockets((self._stations | {spec.name: spec}).values())

    async def begin(self, spec: StationSpec) -> None:
        """Open the sockets for a change to *spec*, which :meth:`follow` or :meth:`end` ends.

        Raises:
            EnvironmentalError: one of them cannot be opened.
        """
        # One change after the other: a socket may be shared with a port of another station.
        await self._changing.acquire()
        try:
            for planned in self._plan_with(spec):
                if planned.key not in self._open:
                    self._open[planned.key] = await self._supervisor.open(planned)
        except BaseException:
            self.end()
            raise

    async def follow(self, spec: StationSpec, changes: PortChanges) -> None:
        """Use the sockets of *spec*, which its station runs, and close the rest."""
        self._stations[spec.name] = spec
        try:
            for follow in self.on_change:
                await follow(spec, changes)
        finally:
            self.end()

    def end(self, *, is_engine_gone: bool = False) -> None:
        """End a change: close the sockets that no port needs, unless an engine may have them."""
        if not is_engine_gone:
            self._close_unused()
        self._changing.release()

    def close_unused(self) -> None:
        """Close the sockets that no port needs, if no change is under way."""
        if not self._changing.locked():
            self._close_unused()

    def _close_unused(self) -> None:
        # Transports have closed theirs.
        wanted = {each.key for each in plan_sockets(self._stations.values())}
        for key in self._open.keys() - wanted:
            _close(self._open.pop(key))
            self._supervisor.close_socket(key)


class SocketFollower:
    """Has the sockets of one station follow the changes of its ports.

    Args:
        table: All sockets.
        station: Name of the station.
    """

    def __init__(self, table: SocketTable, station: str) -> None:
        self._table = table
        self._station = station
        self._changes: PortChanges | None = None
        """Of the change that is under way, if it concerns sockets."""

    async def open(self, spec: StationSpec) -> None:
        """Open the sockets of *spec*; raises as SocketTable.begin."""
        changes = port_changes(self._table.station(self._station), spec, PORT_CONTENT)
        if changes or self._table.has_other_sockets(spec):
            await self._table.begin(spec)
            self._changes = changes

    async def follow(self, spec: StationSpec) -> None:
        """Use the sockets of *spec*, which the station runs."""
        changes, self._changes = self._changes, None
        if changes is not None:
            await self._table.follow(spec, changes)

    async def discard(self, *, is_engine_gone: bool = False) -> None:
        """Close the sockets of a specification that the station does not run.

        They stay open while *is_engine_gone*: the next engine may have started with them, and then
        no other process can open them.
        """
        if self._changes is not None:
            self._changes = None
            self._table.end(is_engine_gone=is_engine_gone)
        elif not is_engine_gone:
            self._table.close_unused()


def _close(opened: SharedSocket) -> None:
    for fd in (opened.engine_fd, opened.services_fd):
        if fd != NO_DESCRIPTOR:
            os.close(fd)


def _with_descriptors(planned: SharedSocket, opened: SharedSocket) -> SharedSocket:
    return SharedSocket(
        planned.kind,
        planned.address,
        planned.port,
        planned.group,
        planned.vlan_id,
        planned.owners,
        opened.engine_fd,
        opened.services_fd,
    )


def owned_copy(fd: int) -> socket.socket:
    """Return a socket of a descriptor of the table, which closes a copy of it."""
    return socket.socket(fileno=os.dup(fd))
