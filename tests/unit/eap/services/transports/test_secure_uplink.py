"""The connection of a station to a router by Secure ADS; the router is written apart from ours."""

from __future__ import annotations

import asyncio
import ssl
import struct
from typing import NamedTuple, Self

import pytest

from eap.ams.spec import SecureRouteSpec
from eap.ids import NetId
from eap.runtime.drop_counters import DropReason
from eap.services.transports import secure_ads
from eap.services.transports.ams_tcp import PeerAddress, UplinkArguments
from eap.services.transports.secure_ads import AmsTlsUplink
from tests.support import aoe
from tests.support.certificates import KeyPair, make_certificate

pytestmark = pytest.mark.net

NET_ID = NetId.parse("1.1.1.1.1.1")
TARGET = "1.1.1.2.2.1"


class Keys(NamedTuple):
    """Certificates of all tests."""

    ca: KeyPair
    station: KeyPair
    plc: KeyPair
    """Signed by the authority, for ``127.0.0.1``."""
    elsewhere: KeyPair
    """Signed by the authority, for another host."""
    pinned: KeyPair


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Keys:
    folder = tmp_path_factory.mktemp("keys")
    ca = make_certificate(folder, "plant-ca")
    return Keys(
        ca,
        make_certificate(folder, "station", by=ca),
        make_certificate(folder, "plc", "127.0.0.1", by=ca),
        make_certificate(folder, "elsewhere", "saw.example", by=ca),
        make_certificate(folder, "pinned", "anybody"),
    )


class Router:
    """Notes what an uplink tells it."""

    name = "left"
    net_id = NET_ID

    def __init__(self) -> None:
        self.seen: asyncio.Queue[bytes | str] = asyncio.Queue()

    def receive(self, data: bytes, transport: str, connection: str) -> None:
        self.seen.put_nowait(data)

    def connection_closed(self, transport: str, connection: str) -> None:
        pass

    def hop_down(self, transport: str, address: str, text: str) -> None:
        self.seen.put_nowait(text)

    def hop_up(self, transport: str, address: str) -> None:
        self.seen.put_nowait("up")

    async def next(self) -> bytes | str:
        return await asyncio.wait_for(self.seen.get(), 10)


def response(*, flags: int = 3, error: int = 0, version: int = 1) -> bytes:
    head = struct.pack("<HHBB6s", 64, flags, version, error, bytes([9, 9, 9, 9, 1, 1]))
    return head.ljust(64, b"\0")


class Plc:
    """A router with a certificate, while the ``async with`` block runs.

    Attributes:
        hello: The message of the latest client.
        streams: Of the clients that got their response.
    """

    def __init__(self, keys: Keys, own: KeyPair, answer: bytes) -> None:
        self._context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        self._context.load_cert_chain(own.certificate, own.key)
        self._context.verify_mode = ssl.CERT_REQUIRED
        self._context.load_verify_locations(keys.ca.certificate)
        self._answer = answer
        self.hello = b""
        self.streams: asyncio.Queue[tuple] = asyncio.Queue()

    async def __aenter__(self) -> Self:
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", 0, ssl=self._context)
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *_: object) -> None:
        self._server.close()
        await self._server.wait_closed()

    async def _serve(self, reader, writer) -> None:
        try:
            self.hello = await reader.readexactly(64)
        except (asyncio.IncompleteReadError, ConnectionError):
            writer.close()
            return
        writer.write(self._answer)
        self.streams.put_nowait((reader, writer))


def run(script, keys: Keys, own: KeyPair, *, answer: bytes = b"", **spec) -> list[DropReason]:
    refused: list[DropReason] = []
    shown = {"certificate": str(keys.station.certificate), "key": str(keys.station.key)}
    settings = SecureRouteSpec(**(shown | spec))

    async def play() -> None:
        router = Router()
        async with Plc(keys, own, answer or response()) as plc:
            peer = PeerAddress("127.0.0.1", plc.port)
            rest = UplinkArguments(
                sources=[], claims={}, count_dropped=refused.append, may_be_client=bool
            )
            name = f"ams-tls:{peer}"
            uplink = AmsTlsUplink(peer, name, str(peer), router, settings=settings, rest=rest)
            task = asyncio.ensure_future(uplink.run())
            try:
                await asyncio.wait_for(script(router, plc, uplink), 20)
            finally:
                task.cancel()
                await asyncio.wait([task])
                while not plc.streams.empty():
                    plc.streams.get_nowait()[1].close()
                await asyncio.sleep(0)

    asyncio.run(play())
    return refused


@pytest.mark.parametrize("mode", ["ca", "fingerprint"])
def test_packets_go_both_ways_without_prefix(keys: Keys, mode: str) -> None:
    request = aoe.packet(TARGET, aoe.READ_STATE, b"ask")
    answer = aoe.packet(TARGET, aoe.READ_STATE, b"tell", flags=5)

    async def script(router: Router, plc: Plc, uplink: AmsTlsUplink) -> None:
        assert uplink.send("", [request]) is None
        assert await router.next() == "up"
        reader, writer = plc.streams.get_nowait()
        assert await reader.readexactly(len(request)) == request
        writer.write(answer[:40])
        await writer.drain()
        writer.write(answer[40:] + answer)
        assert await router.next() == answer == await router.next()
        flags = {"ca": 0, "fingerprint": 0x10}[mode]
        assert struct.unpack_from("<HHBB6s", plc.hello) == (64, flags, 1, 0, bytes(NET_ID))
        writer.close()
        assert "closed by the peer" in str(await router.next())
        assert await router.next() == "up"  # and connects again

    own = {"ca": keys.plc, "fingerprint": keys.pinned}[mode]
    trust = {
        "ca": {"ca": str(keys.ca.certificate)},
        "fingerprint": {"fingerprint": own.fingerprint},
    }
    assert run(script, keys, own, **trust[mode]) == []


@pytest.mark.parametrize(
    ("own", "trust", "text", "reason"),
    [
        (
            "pinned",
            "fingerprint",
            "its certificate has the fingerprint",
            DropReason.TLS_FINGERPRINT,
        ),
        ("pinned", "ca", "certificate not trusted: self-signed", DropReason.TLS_CERTIFICATE),
        ("elsewhere", "ca", "is for saw.example, not for 127.0.0.1", DropReason.TLS_NAME),
    ],
)
def test_wrong_far_end_gets_no_packets(keys: Keys, own: str, trust: str, text: str, reason) -> None:
    async def script(router: Router, plc: Plc, uplink: AmsTlsUplink) -> None:
        assert text in str(await router.next())
        assert plc.hello == b""

    trusted = {"fingerprint": keys.plc.fingerprint, "ca": str(keys.ca.certificate)}[trust]
    assert run(script, keys, getattr(keys, own), **{trust: trusted})[0] is reason


def test_name_is_not_checked_where_the_route_says_so(keys: Keys) -> None:
    async def script(router: Router, plc: Plc, uplink: AmsTlsUplink) -> None:
        assert await router.next() == "up"

    trust = {"ca": str(keys.ca.certificate), "check_name": False}
    assert run(script, keys, keys.elsewhere, **trust) == []


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (response(flags=1, error=1), "does not know this version"),
        (response(flags=1, error=3), "does not know the certificate of this station"),
        (response(flags=1, error=4), "does not know this station"),
        (response(flags=1, error=99), "refused: error 99"),
        (response(version=2), "version 2 of Secure ADS, expected 1"),
        (b"\0\0" * 32, "length 0, expected 64"),
    ],
)
def test_refusal_of_the_far_end_is_the_reason(keys: Keys, answer: bytes, text: str) -> None:
    async def script(router: Router, plc: Plc, uplink: AmsTlsUplink) -> None:
        assert text in str(await router.next())
        assert uplink.send("", [b""]) == "not connected"

    assert run(script, keys, keys.plc, answer=answer, ca=str(keys.ca.certificate)) == []


def test_silent_far_end_is_given_up(keys: Keys, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(secure_ads, "HANDSHAKE_S", 0.5)

    async def script(router: Router, plc: Plc, uplink: AmsTlsUplink) -> None:
        assert "no complete handshake within 0.5 s" in str(await router.next())

    run(script, keys, keys.plc, answer=b"\x40", ca=str(keys.ca.certificate))


def test_missing_file_is_named(keys: Keys) -> None:
    async def script(router: Router, plc: Plc, uplink: AmsTlsUplink) -> None:
        assert "gone.pem: No such file or directory" in str(await router.next())

    run(script, keys, keys.plc, ca="gone.pem")
