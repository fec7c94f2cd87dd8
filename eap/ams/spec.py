"""Specification of a station's routing and access, complete and checked, and its differences.

Plain values only, as in ``eap.pd.spec``: they cross from the supervisor to services as JSON.  An
empty text or tuple stands for "none" or "any" where a field says so.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from enum import StrEnum
from ipaddress import IPv4Address, IPv4Network
from typing import Any

import msgspec
from msgspec.structs import replace

from eap.ids import InterfaceUri, NetId

DEFAULT_TARGET = "default"
"""Name of the default route."""


class SpecStruct(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of all specifications."""


class TransportKind(StrEnum):
    """Kinds of transports for AMS packets."""

    UDP = "udp"
    """Type 5 by UDP."""
    TCP = "tcp"
    """Type 5 by TCP."""
    ETHERNET = "ethernet"
    """Type 5 by EtherType 0x88A4."""
    AMS_TCP = "ams-tcp"
    AMS_TLS = "ams-tls"
    """Secure ADS."""
    MQTT = "mqtt"
    LOCAL = "local"
    """Programs of this appliance."""
    WEB = "web"
    """Browsers: they set variables, and send no packets."""
    OPCUA = "opcua"
    """OPC UA clients; these and the next two set variables likewise."""
    S7 = "s7"
    MODBUS = "modbus"


IP_TRANSPORTS = frozenset(
    (
        *(TransportKind.AMS_TCP, TransportKind.AMS_TLS, TransportKind.UDP, TransportKind.TCP),
        *(TransportKind.WEB, TransportKind.OPCUA, TransportKind.S7, TransportKind.MODBUS),
    )
)
"""Kinds of transports whose connections begin with an IPv4 address."""


NAMED_CLIENTS = (f"{TransportKind.MQTT}:", f"{TransportKind.AMS_TLS}:")
"""Prefixes of transports that stand for clients which somebody has authenticated."""


class HopSpec(SpecStruct, frozen=True):
    """Next hop of packets.

    Attributes:
        kind: Of the transport.
        port: The station's own EAP port that they leave by (UDP, TCP, Ethernet), or the name of
            the network (MQTT); empty for AMS/TCP and Secure ADS.
        address: ``ADDRESS:PORT`` (UDP, TCP), ``HOST:PORT`` (AMS/TCP and Secure ADS, where a host
            may have a name), a MAC address or the NetID of the port that has it (Ethernet), or the
            NetID of a router (MQTT).
    """

    kind: TransportKind
    port: str
    address: str


class PskSpec(SpecStruct, frozen=True):
    """Pre-shared key: an identity, and the absolute path of the file with its password."""

    identity: str
    password_file: str


class SecurePeer(SpecStruct, frozen=True):
    """Client by Secure ADS: its name in access rules, and the fingerprint of its certificate."""

    name: str
    fingerprint: str


class SecureAdsSpec(SpecStruct, frozen=True, kw_only=True):
    """Secure ADS of a station; paths are absolute, files are PEM.

    Attributes:
        certificate: Of the station, with those of the authorities between it and *ca*.
        key: Of that certificate.
        ca: Certificates of authorities whose clients are trusted; empty for none.
        peers: Clients that are trusted by their fingerprints, as those of routes are.
        psk: Clients that are trusted by pre-shared keys.
        port: TCP port of the listener; 0 for none.
    """

    certificate: str
    key: str
    ca: str = ""
    peers: tuple[SecurePeer, ...] = ()
    psk: tuple[PskSpec, ...] = ()
    port: int = 8016


class SecureRouteSpec(SpecStruct, frozen=True, kw_only=True):
    """TLS of a route by Secure ADS; paths are absolute, files are PEM.

    The far end is known by *psk*, else by *fingerprint*, else by an authority of *ca*.  What is
    empty of *ca*, *certificate* and *key* is that of the station's :class:`SecureAdsSpec`.

    Attributes:
        fingerprint: SHA-256 of the certificate of the far end.
        psk: None for certificates.
        ca: Certificates of trusted authorities.
        certificate: That this end shows.
        key: Of that certificate.
        check_name: Whether a certificate that an authority of *ca* signed has to name the host of
            the route.
    """

    fingerprint: str = ""
    psk: PskSpec | None = None
    ca: str = ""
    certificate: str = ""
    key: str = ""
    check_name: bool = True

    def complete(self, own: SecureAdsSpec | None) -> SecureRouteSpec:
        """Return the settings with those of the station where there are none."""
        if own is None:
            return self
        certificate, key = self.certificate or own.certificate, self.key or own.key
        return replace(self, ca=self.ca or own.ca, certificate=certificate, key=key)


class RouteSpec(SpecStruct, frozen=True, kw_only=True):
    """One route.

    Attributes:
        name: Of a station, or the name in the plant file.
        net_id: Of the station, as it really is there; 0.0.0.0.0.0 for a default route.
        hop: Where packets for it go.
        octets: How many bytes of a NetID have to be those of *net_id*: 6, 5 or 4; 0 makes it a
            default route.
        router: NetID of the router at the next hop, which is probed; empty if unknown.
        virtual: NetID by which it is known here instead of *net_id*; empty for none.
        is_unidirectional: Whether requests from there are refused.
        timeout_ms: How long an answer may take; 0 for as long as usual.
        is_probed: Whether the next hop is probed.
        is_derived: Whether it follows from the ports of the plant and not from a route entry.
        is_client: Whether its own end requested it by "add route" (UDP 48899): it may be a client,
            which has connections of its own and does not listen.
        file_flags: ``Flags`` of the StaticRoutes file that it is from, for an export; no effect.
        file_timeout: ``Timeout`` of that file, likewise.
        tls: None unless it goes by Secure ADS.
    """

    name: str
    net_id: str
    hop: HopSpec
    octets: int = 4
    router: str = ""
    virtual: str = ""
    is_unidirectional: bool = False
    timeout_ms: int = 0
    is_probed: bool = True
    is_derived: bool = False
    is_client: bool = False
    file_flags: str = ""
    file_timeout: str = ""
    tls: SecureRouteSpec | None = None


class AccessService(StrEnum):
    """Kinds of operations that access is granted for."""

    READ = "read"
    """Operations that change nothing, also notifications and lookups by name."""
    WRITE = "write"
    """Write and ReadWrite, of objects, variables and IDNs."""
    CONTROL = "control"
    """WriteControl, and states written to a master's groups."""
    FILES = "files"
    """FoE opened for write, and what is written to it."""
    RAW = "raw"
    """EtherCAT commands for a bus, VoE, and what cannot be understood."""
    CONFIGURE = "configure"
    """``plan``, ``apply`` and ``rollback`` by ADS: the configuration of a station, its access
    rules included."""


class ObjectRange(SpecStruct, frozen=True):
    """Objects from *first* to *last*, and of these the subindexes from *low* to *high*."""

    first: int
    last: int
    low: int = 0
    high: int = 0xFF

    def contains(self, other: ObjectRange) -> bool:
        """Return whether all of *other* is in it."""
        return (
            self.first <= other.first
            and other.last <= self.last
            and self.low <= other.low
            and other.high <= self.high
        )

    def overlaps(self, other: ObjectRange) -> bool:
        """Return whether some of *other* is in it."""
        return (
            self.first <= other.last
            and other.first <= self.last
            and self.low <= other.high
            and other.low <= self.high
        )


class Role(StrEnum):
    """Rights of a user, each with those of the ones before."""

    VIEWER = "viewer"
    """Sees everything."""
    OPERATOR = "operator"
    """Sets the variables that the plant file lets operators set."""
    ENGINEER = "engineer"
    """Sets every variable of the application."""


class AccessTarget(SpecStruct, frozen=True):
    """Target of requests: a NetID, given by its first four, five or all six bytes.

    *port* is None for all its AMS ports.
    """

    net_id: str
    port: int | None = None


class AccessRule(SpecStruct, frozen=True):
    """Access rule that grants or refuses; of several rules the first that fits counts.

    An empty tuple stands for anything; otherwise one of its items has to fit.

    Attributes:
        name: For logs and commands.
        allow: Whether it grants or refuses.
        networks: IPv4 networks that a connection comes from (``10.0.0.0/24``).
        macs: MAC addresses that frames come from on Ethernet; an address in one of the two fits.
        net_ids: Source NetIDs, by their first four, five or all six bytes; they prove nothing.
        transports: Names (``mqtt:line``) or kinds (``ams-tcp``, ``ams-tls``, ``udp``, ``tcp``,
            ``ethernet``, ``mqtt``, ``local``, ``web``, ``opcua``, ``s7``, ``modbus``).
        targets: Of the requests.
        services: Kinds of operations.
        objects: Of a dictionary; a rule that has some is about nothing else.
        roles: Of users: a client that has logged in fits by its role, any other one by *members*.
        members: IPv4 networks, MAC addresses and transports of the users with these roles.
    """

    name: str
    allow: bool = True
    networks: tuple[str, ...] = ()
    net_ids: tuple[str, ...] = ()
    transports: tuple[str, ...] = msgspec.field(name="doors", default=())
    targets: tuple[AccessTarget, ...] = ()
    services: tuple[AccessService, ...] = ()
    objects: tuple[ObjectRange, ...] = ()
    macs: tuple[str, ...] = ()
    roles: tuple[Role, ...] = ()
    members: tuple[str, ...] = ()


class AmsUser(SpecStruct, frozen=True):
    """User that may add routes remotely; the first line of *password_file* is the password."""

    name: str
    password_file: str = ""
    """Absolute path, read whenever it is needed; empty for a user of the plant."""


class TlsSpec(SpecStruct, frozen=True):
    """TLS settings of a connection; paths are absolute, files are PEM.

    Attributes:
        ca: Certificates of trusted authorities; empty for those of the system.
        certificate: That this end shows; empty for none.
        key: Of that certificate.
        check_name: Whether the certificate of the other end has to name its host.
    """

    ca: str = ""
    certificate: str = ""
    key: str = ""
    check_name: bool = True


class MqttSpec(SpecStruct, frozen=True, kw_only=True):
    """A broker by which stations reach each other.

    Attributes:
        network: First level of the topics.
        host: Name or address of the broker.
        port: Its TCP port.
        user: Empty for none.
        password_file: Absolute path; its first line is the password.
        tls: None for none.
        client_id: Empty for a generated one.
        no_retain: Whether routers publish their infos again for each new router, and leave none
            retained at the broker.
        is_unidirectional: Whether requests from there are refused.
        qos: Quality of service of what is sent, 0 to 2.
        is_prefixed: Whether packets are sent with the prefix of AMS/TCP in front.
    """

    network: str
    host: str
    port: int = 1883
    user: str = ""
    password_file: str = ""
    tls: TlsSpec | None = None
    client_id: str = ""
    no_retain: bool = False
    is_unidirectional: bool = False
    qos: int = 0
    is_prefixed: bool = False


class RoutingSpec(SpecStruct, frozen=True, kw_only=True):
    """Configuration of the router of a station.

    Attributes:
        routes: Those of the plant file in its order, then the derived ones.
        mqtt: Brokers.
        access: Rules; behind them stand the usual ones: this host may do anything, others read.
        users: May add routes by UDP 48899; without any only programs of this host may.
        learn: Sources of learned routes: ``mqtt:NETWORK``, from the infos of routers
            there, and IPv4 networks, from answers to scans; true for all, false for none.
        secure: Secure ADS; None for none.
    """

    routes: tuple[RouteSpec, ...] = ()
    mqtt: tuple[MqttSpec, ...] = ()
    access: tuple[AccessRule, ...] = ()
    users: tuple[AmsUser, ...] = ()
    learn: bool | tuple[str, ...] = True
    secure: SecureAdsSpec | None = None

    def learns_by_mqtt(self, network: str) -> bool:
        """Return whether routes are learned from the infos of an MQTT network."""
        if isinstance(self.learn, bool):
            return self.learn
        return f"{TransportKind.MQTT}:{network}" in self.learn

    def learns_from(self, address: str) -> bool:
        """Return whether routes are learned from a router scanned at an IPv4 address."""
        if isinstance(self.learn, bool):
            return self.learn
        networks = (each for each in self.learn if not each.startswith(f"{TransportKind.MQTT}:"))
        return any(IPv4Address(address) in IPv4Network(each) for each in networks)


class DirectoryPort(SpecStruct, frozen=True):
    """A port by name; *slaves* are station addresses by the names of the slaves."""

    name: str
    is_bus: bool
    net_id: NetId
    interface: InterfaceUri
    slaves: dict[str, int] = {}


class DirectoryStation(SpecStruct, frozen=True):
    """A station by name, whether it runs here or not."""

    name: str
    net_id: NetId
    ports: tuple[DirectoryPort, ...]


def describe_routing(old: RoutingSpec, new: RoutingSpec) -> list[str]:
    """Return the differences that can be applied at run time, one line each."""
    found = [
        *_differences(_routes(old.routes), _routes(new.routes)),
        *_differences(_rules(old.access), _rules(new.access)),
        *_differences(_users(old.users), _users(new.users)),
        *_differences(_brokers(old.mqtt), _brokers(new.mqtt)),
    ]
    before, after = _order(old.access), _order(new.access)
    if before != after and sorted(before) == sorted(after):
        found.append("access rules: in another order")
    if old.secure != new.secure:
        how = "off" if new.secure is None else "on" if old.secure is None else "changed"
        found.append(f"Secure ADS: {how}")
    if old.learn != new.learn:
        found.append(f"routes are learned from {_sources(new.learn)}")
    return found


def _sources(learn: bool | tuple[str, ...]) -> str:
    if isinstance(learn, bool):
        return "anywhere" if learn else "nowhere"
    return ", ".join(learn) or "nowhere"


def _differences(old: dict[str, Any], new: dict[str, Any]) -> Iterator[str]:
    for name in old:
        if name not in new:
            yield f"{name}: removed"
    for name, each in new.items():
        if name not in old:
            yield f"{name}: added"
        elif old[name] != each:
            yield f"{name}: changed"


def _routes(routes: Iterable[RouteSpec]) -> dict[str, list[RouteSpec]]:
    """Return the routes by what they are called; several NetIDs of a station are one."""
    found: dict[str, list[RouteSpec]] = {}
    for route in routes:
        found.setdefault(f"route {route.name}", []).append(route)
    return found


def _rules(rules: Iterable[AccessRule]) -> dict[str, AccessRule]:
    return {f"access rule {rule.name}": rule for rule in rules}


def _order(rules: Iterable[AccessRule]) -> list[str]:
    return [rule.name for rule in rules]


def _users(users: Iterable[AmsUser]) -> dict[str, AmsUser]:
    return {f"user {user.name}": user for user in users}


def _brokers(brokers: Iterable[MqttSpec]) -> dict[str, MqttSpec]:
    return {f"MQTT network {broker.network}": broker for broker in brokers}
