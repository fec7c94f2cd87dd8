"""The network side of services: what the supervisor opened, with the takers of what arrives."""

from __future__ import annotations

import socket
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from time import monotonic_ns

from eap.appliance.discards import DiscardCounters, Refusal
from eap.appliance.handover import Handover, PortName, SharedSocket, SocketKind
from eap.appliance.services.ams_discovery import AmsDiscovery, RouterName
from eap.appliance.services.ams_door import AmsDoor
from eap.appliance.services.aoe_desk import AoeDesk
from eap.appliance.services.intake import FrameIntake, watch_channel
from eap.appliance.services.mailbox_intake import MailboxIntake, judge
from eap.appliance.services.tcp_door import TcpDoor
from eap.codec.ethercat import MAX_ETHERNET_FRAME, MAX_UDP_FRAME
from eap.ids import InterfaceUri, NetId
from eap.net.ethernet import EthernetInterface, packet_batch
from eap.net.mmsg import ReceiveBatch
from eap.net.udp import UdpChannel


def open_doors(
    handover: Handover,
    desks: Mapping[str, AoeDesk],
    counters: DiscardCounters,
    link: socket.socket,
    resources: ExitStack,
) -> list[TcpDoor | AmsDoor]:
    """Take frames from all sockets of *handover*, as long as the running loop lives.

    Args:
        handover: What the supervisor opened.
        desks: Of the stations, by name.
        counters: Of what is not taken.
        link: To the engine, for connections that belong there.
        resources: Closes what is opened here.

    Returns:
        The listeners for TCP, to be served.
    """
    return _Sockets(handover, desks, counters, resources).open(link)


class _Sockets:
    def __init__(
        self,
        handover: Handover,
        desks: Mapping[str, AoeDesk],
        counters: DiscardCounters,
        resources: ExitStack,
    ) -> None:
        self._handover = handover
        self._desks = desks
        self._counters = counters
        self._resources = resources
        self._batch = ReceiveBatch()
        self._now_ns = monotonic_ns()
        self._unicast: dict[PortName, UdpChannel] = {}

    def open(self, link: socket.socket) -> list[TcpDoor | AmsDoor]:
        by_kind: dict[SocketKind, list[SharedSocket]] = {kind: [] for kind in SocketKind}
        for shared in self._handover.sockets:
            by_kind[shared.kind].append(shared)
        for shared in by_kind[SocketKind.UDP]:
            self._watch_unicast(shared)
        for shared in by_kind[SocketKind.GROUP]:  # these answer by the others
            self._watch_group(shared)
        for shared in by_kind[SocketKind.PACKET]:
            self._watch_interface(shared)
        for shared in by_kind[SocketKind.AMS_UDP]:
            self._watch_discovery(shared)
        doors: list[TcpDoor | AmsDoor] = []
        doors += [self._door(shared, link) for shared in by_kind[SocketKind.TCP]]
        doors += [self._ams_door(shared) for shared in by_kind[SocketKind.AMS_TCP]]
        return doors

    def _channel(self, shared: SharedSocket) -> UdpChannel:
        channel = UdpChannel(socket.socket(fileno=shared.services_fd), self._batch)
        self._resources.callback(channel.close)
        return channel

    def _desks_of(self, stations: Sequence[str]) -> list[AoeDesk]:
        return [self._desks[station] for station in stations]

    def _watch_unicast(self, shared: SharedSocket) -> None:
        channel = self._channel(shared)
        self._unicast.update(dict.fromkeys(shared.owners, channel))
        stations = _stations_of(shared)
        mailbox = MailboxIntake(
            self._desks_of(stations), channel, MAX_UDP_FRAME, lambda data: False
        )
        intake = FrameIntake(stations, self._counters, self._now_ns, mailbox.take)
        channel.takers.append(intake.take)
        watch_channel(channel)

    def _watch_group(self, shared: SharedSocket) -> None:
        channel = self._channel(shared)
        for owner in shared.owners:
            mailbox = MailboxIntake(
                self._desks_of([owner.station]),
                self._unicast[owner],
                MAX_UDP_FRAME,
                lambda data: True,
            )
            intake = FrameIntake([owner.station], self._counters, self._now_ns, mailbox.take)
            channel.takers.append(intake.take)
        watch_channel(channel)

    def _watch_interface(self, shared: SharedSocket) -> None:
        """One door for each VLAN: its ports have one MAC address, and all get what comes there."""
        interface = EthernetInterface(socket.socket(fileno=shared.services_fd), packet_batch())
        self._resources.callback(interface.close)
        served: set[int] = set()
        for owner in shared.owners:
            spec = self._handover.port(owner)
            intake = FrameIntake([owner.station], self._counters, self._now_ns, judge)
            port = interface.port(
                intake.take, vlan_id=spec.vlan_id, priority=spec.vlan_priority, join=spec.join
            )
            if spec.vlan_id not in served:
                served.add(spec.vlan_id)
                stations = [
                    name.station
                    for name in shared.owners
                    if self._handover.port(name).vlan_id == spec.vlan_id
                ]
                desks = self._desks_of(list(dict.fromkeys(stations)))
                mailbox = MailboxIntake(desks, port, MAX_ETHERNET_FRAME, interface.is_for_many)
                intake.mailbox = mailbox.take
        watch_channel(port)

    def _watch_discovery(self, shared: SharedSocket) -> None:
        names = _stations_of(shared)
        routers = [
            RouterName(station.name, NetId.parse(station.net_id))
            for station in self._handover.stations
            if station.name in names
        ]
        AmsDiscovery(self._socket(shared), routers, self._refuser(names)).watch()

    def _ams_door(self, shared: SharedSocket) -> AmsDoor:
        stations = _stations_of(shared)
        return AmsDoor(self._socket(shared), self._desks_of(stations), self._refuser(stations))

    def _door(self, shared: SharedSocket, link: socket.socket) -> TcpDoor:
        stations = _stations_of(shared)
        return TcpDoor(
            self._socket(shared),
            tuple(owner for owner in shared.owners if self._takes_tcp(owner)),
            link,
            self._refuser(stations),
            self._desks_of(stations),
        )

    def _socket(self, shared: SharedSocket) -> socket.socket:
        return self._resources.enter_context(socket.socket(fileno=shared.services_fd))

    def _refuser(self, stations: Sequence[str]) -> Callable[[Refusal], None]:
        def refuse(reason: Refusal) -> None:
            for station in stations:
                self._counters.count(station, reason)

        return refuse

    def _takes_tcp(self, name: PortName) -> bool:
        port = self._handover.port(name)
        return port.tcp or InterfaceUri.parse(port.interface).scheme == "tcp"


def _stations_of(shared: SharedSocket) -> list[str]:
    return list(dict.fromkeys(owner.station for owner in shared.owners))
