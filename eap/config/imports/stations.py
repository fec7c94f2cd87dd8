"""Stations of a plant, made of the EAP devices of imported projects.

Rule 1: a publisher whose destination or settings are not known for certain becomes a comment, so
that nothing is sent on a guess.
Rule 2: the NetID that a publisher sends as its own is either that of its EAP device or that of its
system.  One of them is used, the other one is written beside it.

``resolution`` then connects the stations with each other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from enum import StrEnum
from ipaddress import IPv4Address

import msgspec

from eap.config.imports.records import (
    EapBox,
    EapImportDevice,
    EapVariable,
    ImportOutcome,
    ImportReport,
)
from eap.config.ports import IP_BROADCAST
from eap.ids import BROADCAST_MAC, Destination, InterfaceUri, NetId
from eap.pd.rules import plain_name

DEFAULT_CYCLE_US = 10_000
MIN_CYCLE_US, MAX_CYCLE_US = 100, 60_000_000
_MIN_MONITOR_MS = 100
_MAC = (
    "The MAC address is that of the controller's adapter: take it out where another machine runs"
    " this station."
)
_GATEWAY = "in the project by gateway {}: here the routes of the host decide"


class PublisherIdentity(StrEnum):
    """NetID that a publisher of TwinCAT sends as its own."""

    DEVICE = "device"
    """That of its EAP device."""
    SYSTEM = "system"
    """That of its system, whose router has it too."""


class ImportedSystem(msgspec.Struct, frozen=True, kw_only=True):
    """One controller: its devices, as one or several files describe them.

    Attributes:
        name: Name for the station.
        net_id: NetID of its router; None if no file has it.
        devices: Its EAP devices.
        cycles_us: Cycles of its tasks.
        remarks: Comments on the station.
        type_text: Returns the type of a variable of a file for the plant file; raises ValueError if
            the type cannot be used.
    """

    name: str
    net_id: NetId | None
    devices: tuple[EapImportDevice, ...]
    cycles_us: tuple[int, ...]
    type_text: Callable[[EapVariable, str], str]
    remarks: tuple[str, ...] = ()


class ImportOrigin(msgspec.Struct, frozen=True):
    """Part of a file that something was made of."""

    file: str
    line: int
    item: str


class PlannedVariable(msgspec.Struct, frozen=True):
    """A variable of a station or of a subscription."""

    name: str
    type: str
    comment: str = ""


class PlannedPd(msgspec.Struct, frozen=True, kw_only=True):
    """A PD to send."""

    name: str
    id: int
    version: int
    variable: PlannedVariable
    cycle_us: int = 0


class PlannedFrame(msgspec.Struct, frozen=True, kw_only=True):
    """A frame to send with its PDs; with *reasons* it becomes a comment.

    Attributes:
        name: Name of the frame.
        port: Port that it leaves by.
        to: Destination as in a plant file; empty if it is not known.
        target: NetID of the receiver of unicast frames.
        wanted: Destination in words if the port cannot reach it.
        pds: PDs in the frame.
        divider: See a plant file.
        modulo: See a plant file.
        monitor_ms: Interval of the checks whether the receiver is present, 0 for none.
        is_changeable: A tool may change its destination.
        reasons: Reasons not to send it.
        remarks: Comments beside it.
        origin: Its publisher; None for a frame of a peer.
    """

    name: str
    port: str
    to: str = ""
    target: NetId | None = None
    wanted: str = ""
    pds: tuple[PlannedPd, ...] = ()
    divider: int = 1
    modulo: int = 0
    monitor_ms: int = 0
    is_changeable: bool = False
    reasons: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    origin: ImportOrigin | None = None


class PlannedSubscription(msgspec.Struct, frozen=True, kw_only=True):
    """A PD to receive; with *reasons* it becomes a comment.

    Attributes:
        name: Name of the subscription.
        port: Port that it arrives at.
        source: ``STATION/PD``; empty if the publisher is given by its numbers.
        publisher: NetID of the publisher, None for any.
        id: ID of the PD.
        version: Expected version.
        variable: Variable for its data.
        timeout_ms: Age at which it counts as gone, 0 for never.
        reasons: Reasons not to receive it.
        remarks: Comments beside it.
        origin: Its subscriber; None for a subscription of a peer.
    """

    name: str
    port: str
    source: str = ""
    publisher: NetId | None = None
    id: int
    version: int
    variable: PlannedVariable
    timeout_ms: int = 0
    reasons: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    origin: ImportOrigin | None = None


class PlannedPort(msgspec.Struct, frozen=True, kw_only=True):
    """An EAP port, or a bus port.

    Attributes:
        name: Name of the port.
        interface: Interface as in a plant file.
        net_id: Publisher ID of its frames.
        known_as: All NetIDs by which other controllers may know it.
        mac: Address of the interface; may be empty.
        vlan: VLAN and priority, zeros for none.
        join: Multicast groups of its subscribers.
        remarks: Comments beside it.
        bus: Bus file of a bus port; empty for an EAP port.
        clocks: The clocks of the slaves of a bus port are set.
    """

    name: str
    interface: str
    net_id: NetId
    known_as: frozenset[NetId] = frozenset()
    mac: str = ""
    vlan: tuple[int, int] = (0, 0)
    join: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    bus: str = ""
    clocks: bool = False

    @property
    def scheme(self) -> str:
        """Kind of its interface."""
        return self.interface.partition("://")[0]


class PlannedStation(msgspec.Struct, frozen=True, kw_only=True):
    """A station of the plant file that is written."""

    name: str
    net_id: NetId
    cycle_us: int
    ports: tuple[PlannedPort, ...] = ()
    frames: tuple[PlannedFrame, ...] = ()
    subscriptions: tuple[PlannedSubscription, ...] = ()
    variables: tuple[PlannedVariable, ...] = ()
    """Own variables that no PD carries."""
    remarks: tuple[str, ...] = ()


class UniqueNames:
    """Names that are unique among their like."""

    def __init__(self, used: Iterable[str] = ()) -> None:
        self._used = set(used)
        self._last: dict[str, int] = {}
        """Last number behind a name."""

    def take(self, name: str, owner: str = "") -> str:
        """Return *name*, or one made of *owner* and it, or one with a number."""
        candidates = [name, f"{owner}-{name}"] if owner else [name]
        chosen = next((each for each in candidates if each not in self._used), "")
        base = candidates[-1]
        while not chosen or chosen in self._used:
            self._last[base] = self._last.get(base, 1) + 1
            chosen = f"{base}-{self._last[base]}"
        self._used.add(chosen)
        return chosen


def plan_station(
    system: ImportedSystem,
    interfaces: Iterator[InterfaceUri],
    identity: PublisherIdentity,
    cycle_us: int,
    report: ImportReport,
) -> PlannedStation:
    """Return the station for one controller; its frames to NetIDs have no destination yet.

    Args:
        system: The controller.
        interfaces: Yields the interface of each port.
        identity: NetID that its publishers send as their own.
        cycle_us: Its cycle; 0 for that of its tasks.
        report: Takes notes, and the types that cannot be used.
    """
    return _StationBuilder(system, interfaces, identity, cycle_us, report).build()


class _StationBuilder:
    """One station while it is planned."""

    def __init__(
        self,
        system: ImportedSystem,
        interfaces: Iterator[InterfaceUri],
        identity: PublisherIdentity,
        cycle_us: int,
        report: ImportReport,
    ) -> None:
        self._system = system
        self._report = report
        self._devices = [each for each in system.devices if self._is_enabled(each)]
        self._router, self._ports = self._addresses(interfaces, identity)
        self._guessed = ""
        """Reason that the cycle is a guess."""
        self._cycle_us = cycle_us or self._cycle()
        self._names = UniqueNames()
        self._frame_names = UniqueNames()
        self._sent: dict[tuple[str, int], str] = {}
        self._received: dict[tuple[str, NetId | None, int], str] = {}

    def build(self) -> PlannedStation:
        frames: list[PlannedFrame] = []
        subscriptions: list[PlannedSubscription] = []
        for device, port in zip(self._devices, self._ports, strict=True):
            for box in device.boxes:
                if box.is_publisher:
                    frames.append(self._frame(device, box, port))
                else:
                    subscriptions += self._subscriptions(device, box, port)
        return PlannedStation(
            name=self._system.name,
            net_id=self._router,
            cycle_us=self._cycle_us,
            ports=tuple(self._ports),
            frames=tuple(frames),
            subscriptions=tuple(subscriptions),
            remarks=self._system.remarks,
        )

    def _is_enabled(self, device: EapImportDevice) -> bool:
        if device.is_disabled:
            message = "disabled in the project"
            self._report.note(device.file, device.line, device.name, ImportOutcome.LEFT, message)
        return not device.is_disabled

    def _addresses(
        self, interfaces: Iterator[InterfaceUri], identity: PublisherIdentity
    ) -> tuple[NetId, list[PlannedPort]]:
        """Return the NetID of the router, and the ports with theirs."""
        uris = [next(interfaces) for _ in self._devices]
        known = [self._system.net_id, *(each.net_id for each in self._devices)]
        base = next((each for each in known if each), None)
        if base is None:
            base = made_up_net_id(uris[0] if uris else None)
            self._warn(f"no NetID in the project: {base} is made up, write that of the controller")
        used = {each.net_id for each in self._devices if each.net_id}
        # A file without the NetID of the system may have a device with the usual one of systems.
        system = self._system.net_id or _free_net_id(base, 1, used)
        router = system
        used.add(system)
        own = [
            # TwinCAT gives device 1 the NetID ….2.1, and so on.
            each.net_id or _free_net_id(system, 2 + number, used)
            for number, each in enumerate(self._devices)
        ]
        self._check_unique(own, system)
        sent = list(own)
        if identity is PublisherIdentity.SYSTEM and own:
            # Exchanged, because each NetID is that of one router or port.
            router, sent[0] = own[0], system
        ports = []
        for number, (device, uri) in enumerate(zip(self._devices, uris, strict=True)):
            names = {own[number], *((system,) if not number else ())}
            ports.append(
                PlannedPort(
                    name=f"eap{number}",
                    interface=str(uri),
                    net_id=sent[number],
                    known_as=frozenset(names),
                    mac=device.mac if uri.scheme == "ethernet" else "",
                    vlan=_vlan(device),
                    join=_groups(device, uri.scheme),
                    remarks=(
                        *_identity_remarks(device, identity, sent[number], names - {sent[number]}),
                        *((_MAC,) if device.mac and uri.scheme == "ethernet" else ()),
                    ),
                )
            )
        return router, ports

    def _check_unique(self, own: Sequence[NetId], system: NetId) -> None:
        """Report devices that have the NetID of another one, or of the system."""
        used = {system: "the system"}
        for device, net_id in zip(self._devices, own, strict=True):
            if net_id in used:
                message = f"{device.name}: its AmsNetId {net_id} is that of {used[net_id]} too"
                expected = "a NetID of its own for each device"
                self._report.add(device.file, device.line, message, expected, item=device.name)
            used[net_id] = device.name

    def _cycle(self) -> int:
        linked = {
            variable.cycle_us
            for device in self._devices
            for box in device.boxes
            for variable in box.variables
            if variable.cycle_us
        }
        found = linked or set(self._system.cycles_us)
        if not found or (not linked and len(found) > 1):
            why = "several tasks, and none has a link to EAP" if found else "no task in the files"
            self._guessed = f"its cycle is not known ({why}): give it with --cycle"
            return DEFAULT_CYCLE_US
        cycle_us = min(found)
        limited = min(max(cycle_us, MIN_CYCLE_US), MAX_CYCLE_US)
        if limited != cycle_us:
            self._warn(f"a cycle of {cycle_us} us is out of range: {limited} us is taken")
        return limited

    def _warn(self, message: str) -> None:
        first = next(iter(self._system.devices), None)
        file, line = (first.file, first.line) if first else ("", 0)
        self._report.note(file, line, self._system.name, ImportOutcome.WARNING, message)

    def _frame(self, device: EapImportDevice, box: EapBox, port: PlannedPort) -> PlannedFrame:
        owner = plain_name(box.name, "publisher")
        to, wanted = _destination(box, port)
        reasons = [f"unknown setting in line {each.line}: {each.text}" for each in box.unknown]
        reasons += [self._guessed] if self._guessed else []
        if box.is_disabled:
            reasons.append("disabled in the project")
        if (box.vlan_id, box.vlan_priority) != port.vlan:
            reasons.append(f"its VLAN is {box.vlan_id}, that of the port is {port.vlan[0]}")
        pds = []
        for variable in box.variables:
            planned = self._variable(device, box, variable, owner)
            if planned is not None:
                pd, why = self._pd(box, variable, planned, port)
                pds.append(pd)
                reasons += why
        if not pds:
            reasons.append("it has no variable that can be sent")
        # As TwinCAT does it: a group has no single receiver to look for.
        is_monitored = (
            box.is_monitored and _is_unicast(box, to) and port.scheme in {"udp", "ethernet"}
        )
        return PlannedFrame(
            name=self._frame_names.take(owner),
            port=port.name,
            to=to,
            target=None if to or wanted else box.net_id,
            wanted=wanted,
            pds=tuple(pds),
            divider=box.divider,
            modulo=box.modulo,
            monitor_ms=max(_MIN_MONITOR_MS, box.arp_ms) if is_monitored else 0,
            is_changeable=box.is_changeable,
            reasons=tuple(dict.fromkeys(reasons)),
            remarks=(_GATEWAY.format(box.gateway),) if box.gateway and to else (),
            origin=ImportOrigin(box.file, box.line, f"{device.name}/{box.name}"),
        )

    def _pd(
        self, box: EapBox, variable: EapVariable, planned: PlannedVariable, port: PlannedPort
    ) -> tuple[PlannedPd, list[str]]:
        """Return a PD, and the reasons not to send it."""
        reasons = [f"unknown setting in line {each.line}: {each.text}" for each in variable.unknown]
        first = self._sent.setdefault((port.name, variable.nv_id), planned.name)
        if first != planned.name:
            reasons.append(f"the NvId {variable.nv_id} of {planned.name} is that of {first} too")
        cycle_us = variable.cycle_us if box.divider == 1 else 0
        if cycle_us % self._cycle_us:
            reasons.append(
                f"the task of {planned.name} has a cycle of {cycle_us} us, no multiple of"
                f" {self._cycle_us} us"
            )
        return PlannedPd(
            name=planned.name,
            id=variable.nv_id,
            version=variable.version,
            variable=planned,
            cycle_us=0 if cycle_us <= self._cycle_us else cycle_us,
        ), reasons

    def _variable(
        self, device: EapImportDevice, box: EapBox, variable: EapVariable, owner: str
    ) -> PlannedVariable | None:
        """Return a variable; None, with a finding, if its type cannot be used."""
        try:
            kind = self._system.type_text(variable, box.file)
        except ValueError as exc:
            item = f"{device.name}/{box.name}/{variable.name}"
            expected = "a type with a known layout"
            self._report.add(box.file, variable.line, str(exc), expected, item=item)
            return None
        name = self._names.take(plain_name(variable.name, "variable"), owner)
        return PlannedVariable(name, kind, variable.symbol)

    def _subscriptions(
        self, device: EapImportDevice, box: EapBox, port: PlannedPort
    ) -> Iterator[PlannedSubscription]:
        owner = plain_name(box.name, "subscriber")
        for variable in box.variables:
            planned = self._variable(device, box, variable, owner)
            if planned is None:
                continue
            reasons = ["disabled in the project"] if box.is_disabled else []
            key = port.name, box.net_id, variable.nv_id
            first = self._received.setdefault(key, planned.name)
            if first != planned.name:
                reasons.append(f"its NvId {variable.nv_id} is that of {first} too")
            yield PlannedSubscription(
                name=planned.name,
                port=port.name,
                publisher=box.net_id,
                id=variable.nv_id,
                version=variable.version,
                variable=planned,
                reasons=tuple(reasons),
                # Nothing is sent by a subscriber: it stays, with a comment on what is unknown.
                remarks=tuple(
                    f"unknown setting in line {each.line}: {each.text}"
                    for each in (*box.unknown, *variable.unknown)
                ),
                origin=ImportOrigin(
                    box.file, variable.line, f"{device.name}/{box.name}/{variable.name}"
                ),
            )


def _free_net_id(base: NetId, first: int, used: set[NetId]) -> NetId:
    """Return the first ``BASE.N.1`` from *first* on that is not in *used*, and add it there."""
    head = bytes(base[:4])
    found = next(
        net_id for n in range(first, 256) if (net_id := NetId(head + bytes((n, 1)))) not in used
    )
    used.add(found)
    return found


def made_up_net_id(uri: InterfaceUri | None) -> NetId:
    """Return a NetID for a system that has none: of its address, else one that nobody has."""
    try:
        host = IPv4Address(uri.host if uri else "").packed
    except ValueError:
        host = bytes((10, 88, 164, 1))
    return NetId(host + b"\1\1")


def _destination(box: EapBox, port: PlannedPort) -> tuple[str, str]:
    """Return the destination of a publisher by its address, or in words if that cannot be."""
    if box.udp:
        if port.scheme == "udp":
            return "broadcast" if box.udp == IP_BROADCAST else box.udp, ""
        return "", f"UDP to {box.udp}"
    if box.mac:
        if port.scheme in {"ethernet", "loop"}:
            return "broadcast" if box.mac == str(BROADCAST_MAC) else box.mac, ""
        return "", f"Ethernet to {box.mac}"
    return "", ""


def _is_unicast(box: EapBox, to: str) -> bool:
    if box.net_id is not None and not box.mac and not box.udp:
        return True
    return to not in {"", "broadcast"} and not is_group_address(to)


def is_group_address(text: str) -> bool:
    """Return whether *text* is a multicast or broadcast address, of MAC or IPv4."""
    try:
        return Destination.parse(text).is_group
    except ValueError:
        return text in {"multicast", "broadcast"}


def _vlan(device: EapImportDevice) -> tuple[int, int]:
    """Return the VLAN of a device: that of its first publisher."""
    # TwinCAT has it at each publisher, a plant file at the port.
    publishers = (each for each in device.boxes if each.is_publisher)
    return next(((each.vlan_id, each.vlan_priority) for each in publishers), (0, 0))


def _groups(device: EapImportDevice, scheme: str) -> tuple[str, ...]:
    """Return the multicast groups that the subscribers of *device* receive from."""
    found = {
        box.udp if scheme == "udp" else box.mac
        for box in device.boxes
        if not box.is_publisher and not box.is_disabled
    }
    return tuple(sorted(each for each in found if each and is_group_address(each)))


def _identity_remarks(
    device: EapImportDevice, identity: PublisherIdentity, sent: NetId, others: set[NetId]
) -> tuple[str, ...]:
    """Return the comment on the other NetID that the publishers of *device* may send."""
    if not others or not any(each.is_publisher for each in device.boxes):
        return ()
    other = next(iter(others))
    is_device = identity is PublisherIdentity.DEVICE
    reading = PublisherIdentity.SYSTEM if is_device else PublisherIdentity.DEVICE
    text = (
        f"The publisher ID is {sent}.  TwinCAT 2 sends the NetID of the system, TwinCAT 3 that of"
        f" the device: if frames carry {other}, import with --publisher {reading}."
    )
    return (text,)
