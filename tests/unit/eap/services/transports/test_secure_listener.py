"""The listener for Secure ADS, with clients of Python's TLS that are written apart from ours."""

from __future__ import annotations

import asyncio
import socket
import ssl
import struct
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple, Self

import pytest

from eap.ams.spec import (
    AmsUser,
    HopSpec,
    PskSpec,
    RouteSpec,
    RoutingSpec,
    SecureAdsSpec,
    SecurePeer,
    SecureRouteSpec,
    TransportKind,
)
from eap.codec.secureads import psk_of
from eap.net.limits import ListenerLimits, Rate, SourceRates
from eap.net.tls import HAS_PSK
from eap.runtime.drop_counters import DropReason
from eap.runtime.store import StationStore
from eap.services.routing.station_routes import StationRoutes
from eap.services.transports import ams_tcp, secure_listener
from eap.services.transports.accepting import Listeners
from eap.services.transports.ams_discovery import RouteAdmin
from eap.services.transports.route_logins import RouteLogins
from eap.services.transports.secure_listener import AmsTlsListener, ServerSettings
from tests.support import aoe
from tests.support.certificates import KeyPair, make_certificate
from tests.support.eventually import eventually
from tests.support.routing import station

pytestmark = pytest.mark.net

OWN = "10.0.0.1.1.1"
PANEL = bytes([192, 168, 0, 10, 1, 1])
SELF_SIGNED, ADD_REMOTE, IP_ADDRESS = 0x10, 0x80, 0x20


class Keys(NamedTuple):
    """Certificates of all tests."""

    ca: KeyPair
    server: KeyPair
    client: KeyPair
    """Signed by the authority, for ``panel``."""
    pinned: KeyPair
    stranger: KeyPair
    """Self-signed, and unknown."""
    colon: KeyPair
    """Signed by the authority, for ``10.0.0.9:8016``."""
    twin: KeyPair
    """Signed by the authority, with the name of the pinned one."""
    other: KeyPair
    """Signed by an authority that is not trusted."""
    expired: KeyPair


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Keys:
    folder = tmp_path_factory.mktemp("keys")
    ca = make_certificate(folder, "plant-ca")
    rogue = make_certificate(folder, "rogue-ca")
    return Keys(
        ca,
        make_certificate(folder, "server", algorithm="rsa", by=ca),
        make_certificate(folder, "panel", by=ca),
        make_certificate(folder, "pinned"),
        make_certificate(folder, "stranger"),
        make_certificate(folder, "colon", "10.0.0.9:8016", by=ca),
        make_certificate(folder, "twin", "pinned", by=ca),
        make_certificate(folder, "other", by=rogue),
        make_certificate(folder, "expired", by=ca, days=-1),
    )


@pytest.fixture(autouse=True)
def state(tmp_path, monkeypatch):
    monkeypatch.setenv("EAP_STATE_DIR", str(tmp_path / "state"))


def hello(flags: int = 0, *, version: int = 1, user: bytes = b"", password: bytes = b"") -> bytes:
    """Return the client's message, put together from the public layout."""
    length = 64 + len(user) + len(password)
    head = struct.pack("<HHBB6sBB18x", length, flags, version, 0, PANEL, len(user), len(password))
    return head + b"panel".ljust(32, b"\0") + user + password


def client_context(shown: KeyPair | None, *, ciphers: str = "") -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    if shown is not None:
        context.load_cert_chain(shown.certificate, shown.key)
    if ciphers:
        context.maximum_version = ssl.TLSVersion.TLSv1_2
        context.set_ciphers(ciphers)
    return context


class Server:
    """A listener of a station while the ``async with`` block runs.

    Attributes:
        refused: Counted reasons.
        routes: Of the station.
        router: Of the station.
        transports: Names of those that the router has.
    """

    def __init__(
        self, keys: Keys, *, peers: tuple[SecurePeer, ...] | None = None,
        psk: tuple[PskSpec, ...] = (), **told,
    ) -> None:  # fmt: skip
        if peers is None:
            peers = (SecurePeer("pinned", keys.pinned.fingerprint),)
        spec = SecureAdsSpec(
            certificate=str(keys.server.certificate),
            key=str(keys.server.key),
            ca=str(keys.ca.certificate),
            peers=peers,
            psk=psk,
        )
        self.router = station(OWN, name="left")
        self.transports: set[str] = set()
        self._note_transports()
        routing = RoutingSpec(secure=spec, **told)
        self.routes = StationRoutes(self.router, routing, StationStore("demo", "left").routes)
        self.routes.start()
        self.refused: list[DropReason] = []
        self._spec = spec

    def _note_transports(self) -> None:
        add, remove = self.router.add_transport, self.router.remove_transport

        def note_added(transport, sender) -> None:
            self.transports.add(transport.name)
            add(transport, sender)

        def note_removed(name: str) -> None:
            self.transports.remove(name)
            remove(name)

        self.router.add_transport, self.router.remove_transport = note_added, note_removed

    async def __aenter__(self) -> Self:
        listener = socket.create_server(("127.0.0.1", 0))
        self.address = listener.getsockname()
        admin = RouteAdmin([self.routes], RouteLogins())
        settings = ServerSettings(self._spec, self.routes.secure_clients, admin)
        listeners = Listeners()
        self.listener = AmsTlsListener(
            listener, self.router, settings, self.refused.append, listeners
        )
        self._task = asyncio.ensure_future(self.listener.serve())
        return self

    async def __aexit__(self, *_: object) -> None:
        self._task.cancel()
        await asyncio.wait([self._task])
        self.listener.close()

    async def connect(self, shown: KeyPair | None, **more: str):
        context = client_context(shown, **more)
        return await asyncio.open_connection(*self.address, ssl=context)

    async def greet(self, shown: KeyPair | None, message: bytes) -> tuple[bytes, bytes]:
        """Return the response, and what follows before the server closes the connection."""
        reader, writer = await self.connect(shown)
        writer.write(message)
        response = await reader.readexactly(64)
        try:
            rest = await asyncio.wait_for(reader.read(), 5) if response[5] else b""
        finally:
            writer.close()
        return response, rest


def play(script: Callable, *arguments: object, **told: object) -> Server:
    async def run() -> Server:
        async with Server(*arguments, **told) as server:
            await asyncio.wait_for(script(server), 20)
            return server

    return asyncio.run(run())


async def read_state(reader, writer, *, invoke_id: int = 1) -> bytes:
    """Return the answer to a request for the state of the station, without prefix."""
    writer.write(aoe.packet(OWN, aoe.READ_STATE, b"", invoke_id=invoke_id, port=10000))
    head = await reader.readexactly(32)
    (length,) = struct.unpack_from("<I", head, 20)
    return head + await reader.readexactly(length)


@pytest.mark.parametrize(("who", "flags"), [("client", 0), ("pinned", SELF_SIGNED)])
def test_known_client_gets_answers_without_prefix(keys: Keys, who: str, flags: int) -> None:
    async def script(server: Server) -> None:
        reader, writer = await server.connect(getattr(keys, who))
        writer.write(hello(flags))
        response = await reader.readexactly(64)
        assert struct.unpack_from("<HHBB", response) == (64, 0x03, 1, 0)
        assert response[6:12] == bytes(map(int, OWN.split(".")))
        for number in range(3):
            answer = await read_state(reader, writer, invoke_id=number)
            assert struct.unpack_from("<I", answer, 28) == (number,)
        name = {"client": "panel"}.get(who, who)
        assert server.transports == {f"ams-tls:{name}"}
        writer.close()
        await eventually(lambda: not server.transports)

    assert play(script, keys).refused == []


def test_message_and_requests_in_one_piece_are_answered(keys: Keys) -> None:
    async def script(server: Server) -> None:
        reader, writer = await server.connect(keys.pinned)
        packet = aoe.packet(OWN, aoe.READ_STATE, b"", port=10000)
        writer.write(hello(SELF_SIGNED) + packet + packet[:40])
        writer.write(packet[40:])
        await reader.readexactly(64)
        await reader.readexactly(2 * 32)  # error 6: nothing is served here
        writer.close()

    play(script, keys)


@pytest.mark.parametrize("ciphers", ["DHE-RSA-AES256-SHA256", "DHE-RSA-AES128-GCM-SHA256"])
def test_methods_of_the_description_are_offered(keys: Keys, ciphers: str) -> None:
    async def script(server: Server) -> None:
        _, writer = await server.connect(keys.pinned, ciphers=ciphers)
        assert writer.get_extra_info("cipher")[:2] == (ciphers, "TLSv1.2")
        writer.close()

    play(script, keys)


@pytest.mark.parametrize(
    ("who", "message", "error", "reason"),
    [
        ("stranger", hello(SELF_SIGNED), 3, DropReason.TLS_FINGERPRINT),
        ("client", hello(version=2), 1, DropReason.TLS_VERSION),
        ("colon", hello(), 2, DropReason.TLS_NAME),
        ("twin", hello(), 2, DropReason.TLS_NAME),
        ("stranger", hello(ADD_REMOTE, user=b"me", password=b"no"), 4, DropReason.TLS_USER),
    ],
    ids=["stranger", "version", "colon", "twin", "password"],
)
def test_refused_client_gets_the_error_and_nothing_else(
    keys: Keys, who: str, message: bytes, error: int, reason: DropReason
) -> None:
    packet = aoe.packet(OWN, aoe.READ_STATE, b"", port=10000)

    async def script(server: Server) -> None:
        response, rest = await server.greet(getattr(keys, who), message + packet)
        assert struct.unpack_from("<HHBB", response) == (64, 0x01, 1, error)
        assert rest == b""
        assert not server.transports

    users = (AmsUser("me", "/dev/null"),)
    assert play(script, keys, users=users).refused == [reason]


@pytest.mark.parametrize("who", ["other", "expired", None])
def test_certificate_that_nobody_trusts_ends_the_handshake(keys: Keys, who: str | None) -> None:
    async def script(server: Server) -> None:
        with pytest.raises((ssl.SSLError, ConnectionError, asyncio.IncompleteReadError)):
            await server.greet(getattr(keys, who) if who else None, hello())
        await eventually(lambda: server.refused)

    assert play(script, keys).refused == [DropReason.TLS_CERTIFICATE]


@pytest.mark.parametrize(
    "octets", [b"GET / HTTP/1.1\r\n\r\n", bytes(100), b"\x16\x03\x01\xff\xff" + bytes(70_000), b""]
)
def test_other_bytes_than_tls_are_counted(keys: Keys, octets: bytes) -> None:
    async def script(server: Server) -> None:
        _, writer = await asyncio.open_connection(*server.address)
        writer.write(octets)
        writer.close()
        await eventually(lambda: server.refused)

    assert play(script, keys).refused == [DropReason.TLS_HANDSHAKE]


@pytest.mark.parametrize("message", [b"", b"\x40", hello()[:63], b"\x3f\x00", b"\xff\xff" * 40])
def test_damaged_message_is_counted(keys: Keys, message: bytes) -> None:
    async def script(server: Server) -> None:
        _, writer = await server.connect(keys.pinned)
        writer.write(message)
        writer.close()
        await eventually(lambda: server.refused)

    assert play(script, keys).refused == [DropReason.TLS_INFO]


def test_packet_with_prefix_closes_the_connection(keys: Keys) -> None:
    async def script(server: Server) -> None:
        reader, writer = await server.connect(keys.pinned)
        packet = aoe.packet(OWN, aoe.READ_STATE, b"", port=10000)
        writer.write(hello(SELF_SIGNED) + struct.pack("<HI", 0, len(packet)) + packet)
        await reader.readexactly(64)
        assert await reader.read() == b""
        writer.close()

    assert play(script, keys).refused == [DropReason.AMS_TYPE]


def test_slow_handshake_is_ended(keys: Keys, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(secure_listener, "HANDSHAKE_S", 0.2)

    async def script(server: Server) -> None:
        bare, plain = await asyncio.open_connection(*server.address)
        silent, encrypted = await server.connect(keys.pinned)
        for reader, writer in ((bare, plain), (silent, encrypted)):
            assert await reader.read() == b""
            writer.close()
        await eventually(lambda: len(server.refused) == 2)

    assert play(script, keys).refused == [DropReason.TLS_SLOW] * 2


def test_half_open_connections_do_not_shut_others_out(
    keys: Keys, monkeypatch: pytest.MonkeyPatch
) -> None:
    ample = Rate(1000, 1000.0)
    monkeypatch.setattr(secure_listener, "RATES", SourceRates(ample, ample, ample, ample))
    monkeypatch.setattr(ams_tcp, "LIMITS", ListenerLimits(16, 4, 8))

    async def script(server: Server) -> None:
        flood = [await asyncio.open_connection(*server.address) for _ in range(50)]
        for _ in range(3):
            reader, writer = await server.connect(keys.pinned)
            flood.append((reader, writer))
            writer.write(hello(SELF_SIGNED))
            await reader.readexactly(64)
            await read_state(reader, writer)
        flood += [await asyncio.open_connection(*server.address) for _ in range(50)]
        await read_state(reader, writer)  # and those that are in use stay
        for _, other in flood:
            other.close()

    play(script, keys)


def test_connections_faster_than_the_rate_are_refused(
    keys: Keys, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = Rate(2, 0.001)
    monkeypatch.setattr(secure_listener, "RATES", SourceRates(few, few, few, few))

    async def script(server: Server) -> None:
        for _ in range(5):
            reader, writer = await asyncio.open_connection(*server.address)
            writer.write(b"no TLS at all, but long enough for a record")
            with suppress(ConnectionError):
                await reader.read()
            writer.close()
        await eventually(lambda: len(server.refused) == 5)

    refused = play(script, keys).refused
    assert refused.count(DropReason.TLS_FULL) == 3


def test_client_with_user_and_password_adds_a_route_and_is_known_after_that(
    keys: Keys, tmp_path
) -> None:
    (tmp_path / "secret").write_text("Müller\n")
    request = hello(
        ADD_REMOTE | SELF_SIGNED | IP_ADDRESS, user=b"me", password="Müller".encode("cp1252")
    )

    async def script(server: Server) -> None:
        reader, writer = await server.connect(keys.stranger)
        writer.write(request)
        response = await reader.readexactly(64)
        assert struct.unpack_from("<HHBB", response) == (64, 0x03, 1, 0)
        await read_state(reader, writer)
        writer.close()
        (added,) = server.routes.added
        assert added.hop == HopSpec(TransportKind.AMS_TLS, "", "127.0.0.1:8016")
        assert added.tls == SecureRouteSpec(fingerprint=keys.stranger.fingerprint)
        assert (added.name, added.net_id, added.is_client) == ("panel", "192.168.0.10.1.1", True)
        response, _ = await server.greet(keys.stranger, hello(SELF_SIGNED))
        assert response[5] == 0
        await server.routes.remove("panel")
        response, _ = await server.greet(keys.stranger, hello(SELF_SIGNED))
        assert response[5] == 3

    users = (AmsUser("me", str(tmp_path / "secret")),)
    assert play(script, keys, users=users).refused == [DropReason.TLS_FINGERPRINT]


def test_far_end_of_a_route_is_known_unless_the_route_is_unidirectional(keys: Keys) -> None:
    def route(name: str, net_id: str, of: KeyPair, **more: bool) -> RouteSpec:
        hop = HopSpec(TransportKind.AMS_TLS, "", f"{name}.example:8016")
        tls = SecureRouteSpec(fingerprint=of.fingerprint)
        return RouteSpec(name=name, net_id=net_id, hop=hop, tls=tls, **more)

    async def script(server: Server) -> None:
        assert (await server.greet(keys.stranger, hello()))[0][5] == 0
        assert (await server.greet(keys.pinned, hello()))[0][5] == 3

    routes = (
        route("plc", "1.2.3.4.1.1", keys.stranger),
        route("shy", "1.2.3.5.1.1", keys.pinned, is_unidirectional=True),
    )
    assert play(script, keys, peers=(), routes=routes).refused == [DropReason.TLS_FINGERPRINT]


@pytest.mark.skipif(not HAS_PSK, reason="pre-shared keys need Python 3.13 or newer")
@pytest.mark.parametrize(
    ("identity", "password", "is_known"),
    [("Panel-1", b"timber", True), ("panel-1", b"wrong", False), ("nobody", b"timber", False)],
)
def test_pre_shared_key_names_its_client(
    keys: Keys, tmp_path, identity: str, password: bytes, is_known: bool
) -> None:
    (tmp_path / "secret").write_text("timber\n")
    context = client_context(None, ciphers="PSK-AES128-CBC-SHA256")
    key = psk_of(identity, password)
    context.set_psk_client_callback(lambda hint: (identity, key))

    async def script(server: Server) -> None:
        try:
            reader, writer = await asyncio.open_connection(*server.address, ssl=context)
        except OSError:
            await eventually(lambda: server.refused)
            return
        writer.write(hello())
        assert (await reader.readexactly(64))[5] == 0
        await read_state(reader, writer)
        assert server.transports == {"ams-tls:panel-1"}
        writer.close()

    psk = (PskSpec("panel-1", str(tmp_path / "secret")),)
    refused = [] if is_known else [DropReason.TLS_HANDSHAKE]
    assert play(script, keys, psk=psk).refused == refused
