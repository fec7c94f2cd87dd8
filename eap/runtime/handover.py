"""Handover of the supervisor to its child processes.

Specifications, descriptors and options travel as JSON in an anonymous file whose descriptor the
child inherits.  So the size has no limit, no other process can read it, and nothing is left behind.
"""

from __future__ import annotations

import os
from enum import StrEnum
from typing import Self

import msgspec

from eap.ams.spec import DirectoryStation, RoutingSpec
from eap.config.plant_sections import HostSection
from eap.config.record_sections import RecordSection
from eap.config.users import PlantUserSection
from eap.config.web_sections import MetricsSection, WebSection
from eap.ids import decode_value, encode_value
from eap.pd.device import DeviceState
from eap.pd.spec import PortSpec, SpecRecord, StationSpec

NO_DESCRIPTOR = -1


class SocketKind(StrEnum):
    """Kind of a shared socket."""

    UDP = "udp"
    """A pair bound to one unicast address, sorted by frame type."""
    GROUP = "group"
    """A pair bound to one multicast group, or to the broadcast address, at one interface."""
    PACKET = "packet"
    """A pair of AF_PACKET sockets on one Ethernet interface."""
    TCP = "tcp"
    """One listener, for services."""
    ARP = "arp"
    """One AF_PACKET socket for services, which probes for subscribers in one VLAN."""
    AMS_TCP = "ams_tcp"
    """One listener, for services; the ports of an address share it."""
    AMS_UDP = "ams_udp"
    """One socket for services, on which tools ask for the routers at an address."""
    AMS_BROADCAST = "ams_broadcast"
    """One socket for services, on which they ask all hosts of the address's network; none where
    that does not work.  Without a group it is the broadcast address of the network."""
    GATEWAY_UDP = "gateway_udp"
    """One socket for services, for the mailbox gateway of one bus port."""
    GATEWAY_TCP = "gateway_tcp"
    """One listener for services, likewise."""


class PortName(SpecRecord, frozen=True, order=True):
    """A port and its station."""

    station: str
    port: str


class SharedSocket(SpecRecord, frozen=True):
    """One socket, or one pair, that the supervisor opens once and keeps open.

    *address* is an IPv4 address or the name of an Ethernet interface.
    """

    kind: SocketKind
    address: str
    port: int = 0
    group: str = ""
    vlan_id: int = 0
    """ARP only; 0 is untagged."""
    owners: tuple[PortName, ...] = ()
    """Ports whose frames arrive here; several share a group, a broadcast or an interface."""
    engine_fd: int = NO_DESCRIPTOR
    services_fd: int = NO_DESCRIPTOR

    @property
    def key(self) -> SharedSocket:
        """The socket without owners and descriptors, which change."""
        return SharedSocket(self.kind, self.address, self.port, self.group, self.vlan_id)


class BusSocket(SpecRecord, frozen=True):
    """Lines of one bus port to its slaves, opened once like the shared sockets.

    A port with another interface, second line or simulation has another bus.
    """

    owner: PortName
    number: int = 0
    """Number of the bus in requests, which no other bus of the appliance ever has."""
    engine_fd: int = NO_DESCRIPTOR
    """Socket of the engine's frames: packet, UDP, or a pair with the segment process."""
    segment_fd: int = NO_DESCRIPTOR
    """The other side of that pair, for the process of a simulated segment."""
    segment_command_fd: int = NO_DESCRIPTOR
    """Socket on which that process receives commands, one JSON object each, and answers them."""
    command_fd: int = NO_DESCRIPTOR
    """The other side of that pair, for services."""
    second_fd: int = NO_DESCRIPTOR
    """Socket of the second line of a ring, for the engine."""
    segment_second_fd: int = NO_DESCRIPTOR
    """The other side of its pair, for the process of a simulated segment."""
    interface: str = ""
    redundant: str = ""
    """Interface of the second line of a ring."""
    simulated: str = ""
    """Digest of the simulated slaves."""

    @property
    def key(self) -> BusSocket:
        """The bus without number and descriptors."""
        return BusSocket(
            self.owner,
            interface=self.interface,
            redundant=self.redundant,
            simulated=self.simulated,
        )

    @property
    def is_simulated(self) -> bool:
        """True if a process of the appliance is its slaves."""
        return self.interface.startswith("sim:")


class InheritedRecord(SpecRecord, frozen=True):
    """Record that a child process inherits in a descriptor."""

    def to_descriptor(self) -> int:
        """Return the descriptor of a file that holds this; the caller closes it."""
        # No file in a directory: nothing is left behind, and no size limit of a pipe applies.
        fd = os.memfd_create("eap-handover", os.MFD_CLOEXEC)
        with os.fdopen(os.dup(fd), "wb") as file:
            file.write(msgspec.json.encode(self, enc_hook=encode_value))
        return fd

    @classmethod
    def from_descriptor(cls, fd: int) -> Self:
        """Read what ``to_descriptor`` wrote, and close *fd*."""
        with os.fdopen(fd, "rb") as file:
            # The offset is shared with the parent, whose writing left it at the end.
            file.seek(0)
            return msgspec.json.decode(file.read(), type=cls, dec_hook=decode_value)


class SegmentHandover(InheritedRecord, frozen=True):
    """All that the process of a simulated segment gets."""

    supervisor: int
    """Process id, as in Handover."""
    file: str
    """The bus file."""
    digest: str
    """Of the slaves that it had when it was applied; empty for whatever it has now."""
    copy: str
    """File with these slaves, as long as the appliance runs."""
    frames_fd: int
    """This side of the pair with the engine."""
    command_fd: int
    """This side of the pair with services."""
    second_fd: int = NO_DESCRIPTOR
    """This side of the pair with the engine for the second line of a ring."""
    realtime: bool = False
    """As in EngineOptions."""


class WebHandover(InheritedRecord, frozen=True):
    """All that the process of the page, or of metrics alone, gets."""

    supervisor: int
    """Process id, as in Handover."""
    folder: str
    """The appliance's runtime folder."""
    plant: str
    web: WebSection | None = None
    metrics: MetricsSection | None = None
    """Only if there is no *web*."""


class BridgeHandover(InheritedRecord, frozen=True):
    """All that the process of a bridge gets."""

    supervisor: int
    """Process id, as in Handover."""
    folder: str
    """The appliance's runtime folder."""
    plant: str
    name: str
    """Key of the plant file."""
    section: msgspec.Raw
    """Its section with resolved paths, as JSON: only the bridge knows the type."""


class RecorderHandover(InheritedRecord, frozen=True):
    """All that the recorder of a recording of the plant file gets."""

    supervisor: int
    """Process id, as in Handover."""
    folder: str
    """The appliance's runtime folder."""
    plant: str
    record: RecordSection


class EngineOptions(SpecRecord, frozen=True):
    """Scheduling of the engine."""

    realtime: bool = True
    """Request SCHED_FIFO, locked memory and PM QoS; the engine reports what is not permitted."""
    cpu: int = -1
    """Run on this processor only; -1 on any."""
    priority: int = 50
    """Of SCHED_FIFO, 1 to 99."""
    spins: bool = False
    """Poll instead of sleeping between two cycles; the plant file has it."""


class Handover(InheritedRecord, frozen=True):
    """All that engine and services get; a descriptor that it does not need is NO_DESCRIPTOR."""

    supervisor: int
    """Process id: a child with another parent has been orphaned."""
    folder: str
    """The appliance's runtime folder."""
    plant: str
    plant_file: str
    stations: tuple[StationSpec, ...]
    sockets: tuple[SharedSocket, ...]
    link_fd: int = NO_DESCRIPTOR
    """This side of the SOCK_SEQPACKET pair between engine and services."""
    control_fd: int = NO_DESCRIPTOR
    buses: tuple[BusSocket, ...] = ()
    bus_fd: int = NO_DESCRIPTOR
    """This side of the pair for requests of services to the engine."""
    supervisor_fd: int = NO_DESCRIPTOR
    """Services' side of the pair for requests to the supervisor."""
    options: EngineOptions = EngineOptions()
    states: dict[str, DeviceState] = msgspec.field(default_factory=dict)
    """To which each station is brought, Op if it is not here."""
    first_state: DeviceState = DeviceState.OP
    """Of stations for which no other state was requested."""
    routing: dict[str, RoutingSpec] = msgspec.field(default_factory=dict)
    """Configuration of the router of each station; empty for one that is not here."""
    directory: tuple[DirectoryStation, ...] = ()
    """Names of everything in the plant, also of stations on other hosts."""
    audit_required: bool = False
    """True if changes that cannot be recorded fail."""
    host: str = ""
    """Host of the plant that this computer is; empty without ``hosts``."""
    hosts: tuple[HostSection, ...] = ()
    """All hosts of the plant."""
    users: tuple[PlantUserSection, ...] = ()
    """Users of the plant; without any, each client of the control socket may do everything."""
    operators: tuple[str, ...] = ()
    """Patterns of the variables that operators set by the control socket."""

    def port(self, name: PortName) -> PortSpec:
        """Return the specification of one port."""
        return next(
            port
            for station in self.stations
            if station.name == name.station
            for port in station.ports
            if port.name == name.port
        )
