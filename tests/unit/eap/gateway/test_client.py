"""The blocking client against a gateway in a thread, by UDP and TCP."""

from __future__ import annotations

import io
import socket

import pytest

from devicebus.errors import BusError, FoeError, MailboxRefusedError, MailboxTimeoutError, SoeError
from devicebus.mailbox import foe_client
from devicebus.mailbox.conversation import Progress
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.soe import Idn
from eap.errors import EnvironmentalError
from eap.gateway.client import GatewayClient, cut_frame
from eap.od.abort import SdoAbortError
from tests.support.fakegateway import FILE, SIZES, FakeGateway

pytestmark = pytest.mark.net

MODE = Idn.parse("S-0-0032")


@pytest.fixture(scope="module")
def gateway():
    with FakeGateway() as running:
        yield running


@pytest.fixture(params=[False, True], ids=["udp", "tcp"])
def client(request, gateway):
    with GatewayClient("127.0.0.1", gateway.port, tcp=request.param, timeout_s=5) as connected:
        yield connected


def test_objects_of_any_size(client) -> None:
    client.sdo_write(1001, 0x2000, 0, b"1234")
    assert client.sdo_read(1001, 0x2000) == b"1234"
    client.sdo_write(1001, 0x1008, 0, b"y" * 400)
    assert client.sdo_read(1001, 0x1008) == b"y" * 400
    assert client.sdo_read(0, 0x1008) == b"M"
    with pytest.raises(SdoAbortError, match="object does not exist"):
        client.sdo_read(1001, 0x9999)


def test_descriptions(client) -> None:
    assert client.od_list(1001) == [0x1008, 0x2000]
    assert client.od_object(1001, 0x2000).name == "A"
    assert client.od_entry(1001, 0x2000, 0).bit_length == 32


def test_idns(client) -> None:
    assert client.idn_read(1001, MODE) == bytes((7, 0, 0, 0))
    assert client.idn_describe(1001, MODE).name == "Mode"
    client.idn_write(1001, MODE, bytes((7, 0, 0, 0)))
    with pytest.raises(SoeError):
        client.idn_read(1001, Idn.parse("P-0-0001"))


def test_files(client) -> None:
    progress = Progress()
    client.foe_write(1001, "f", FILE, progress=progress)
    assert progress.done == len(FILE)
    assert client.foe_read(1001, "f") == FILE
    with pytest.raises(FoeError):
        client.foe_read(1001, "none")


def test_vendors_protocols(client) -> None:
    assert client.voe(1001, 0x1164, 1, b"\1\2") == b"\1\2"


def test_slaves(client) -> None:
    (slave,) = client.slaves()
    assert (slave.station, slave.name, slave.vendor, slave.al_status) == (1001, "drive", 5, 8)
    assert client.sizes_of(0x8000 | 1001).to_slave == 140
    with pytest.raises(BusError, match=r"unknown slave 7; known slaves: 1001 \(drive\)"):
        client.sizes_of(7)
    with pytest.raises(MailboxRefusedError):
        client.sdo_read(7, 0x1018)
    client.mailboxes[7] = MailboxSizes(64, 80)
    assert client.sizes_of(7).to_slave == 64


def test_client_of_a_gateway_that_is_silent_at_address_0_writes_objects_and_idns() -> None:
    with (
        FakeGateway() as gateway,
        GatewayClient("127.0.0.1", gateway.port, timeout_s=0.01, tries=20) as client,
    ):
        gateway.is_master_silent = True
        client.sdo_write(1001, 0x1008, 0, b"y" * 400)
        asked = gateway.addresses.count(0)
        client.sdo_write(1001, 0x1008, 0, b"z" * 400)
        client.idn_write(1001, MODE, bytes((7, 0, 0, 0)))
        assert client.sdo_read(1001, 0x1008) == b"z" * 400
        assert gateway.addresses.count(0) == asked, "once is enough"
        with pytest.raises(MailboxTimeoutError) as caught:
            client.foe_read(1001, "f")
        assert "put its sizes into mailboxes[1001]" in caught.value.__notes__[0]
        client.mailboxes[1001] = SIZES
        client.foe_write(1001, "f", FILE)
        assert client.foe_read(1001, "f") == FILE


def test_a_datagram_that_got_lost_is_sent_again(gateway) -> None:
    with GatewayClient("127.0.0.1", gateway.port, timeout_s=0.02, tries=50) as client:
        gateway.drop = 2
        assert client.sdo_read(0, 0x1008) == b"M"
    with GatewayClient("127.0.0.1", gateway.port, timeout_s=0.05) as client:
        gateway.drop = 3
        silent = rf"from address 0: gateway 127\.0\.0\.1:{gateway.port} was silent for 0\.15 s"
        with pytest.raises(MailboxTimeoutError, match=silent):
            client.sdo_read(0, 0x1008)


def test_client_without_a_gateway_raises() -> None:
    refused = (
        r"gateway 127\.0\.0\.1:1 does not answer: Connection refused: no gateway listens there"
    )
    with pytest.raises(BusError, match=refused):
        GatewayClient("127.0.0.1", 1, tcp=True)
    with (
        GatewayClient("127.0.0.1", 1) as client,
        pytest.raises(BusError, match=refused),
    ):
        client.sdo_read(0, 0x1000)
    with pytest.raises(EnvironmentalError, match=r"gateway ü..x:34980: it is no name of a host"):
        GatewayClient("ü..x")


@pytest.mark.parametrize("is_read", [True, False], ids=["read", "write"])
def test_a_file_that_is_broken_off_frees_the_slave(gateway, client, is_read) -> None:
    def leave() -> None:
        raise KeyboardInterrupt

    sizes = client.sizes_of(1001)
    talk = (
        foe_client.read("f", bytes, sizes)
        if is_read
        else foe_client.write("f", io.BytesIO(FILE).read, sizes)
    )
    before = len(gateway.heard)
    with pytest.raises(KeyboardInterrupt):
        client.converse(1001, talk, leave)
    assert client.foe_read(1001, "f") == FILE
    assert bytes.fromhex("0500 00800000") in gateway.heard[before:]


def test_a_connection_that_is_closed() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        client = GatewayClient("127.0.0.1", server.getsockname()[1], tcp=True)
        server.accept()[0].close()
        with client, pytest.raises(BusError, match=r"closed|does not answer"):
            client.sdo_read(0, 0x1000)


def test_meanwhile_is_called(client) -> None:
    from devicebus.mailbox import coe_client

    calls = []
    client.converse(1001, coe_client.upload(0x2000, 0), lambda: calls.append(1))
    assert calls


def test_frames_of_a_stream() -> None:
    frame = bytes.fromhex("04 50 01020304")
    assert cut_frame(b"") == (None, b"")
    assert cut_frame(frame[:4]) == (None, frame[:4])
    assert cut_frame(frame + b"x") == (frame, b"x")


def test_reply_that_waits_in_the_socket_does_not_answer_the_next_request() -> None:
    with (
        FakeGateway() as gateway,
        GatewayClient("127.0.0.1", gateway.port) as client,
        GatewayClient("127.0.0.1", gateway.port) as other,
    ):
        other.sdo_write(1001, 0x2000, 0, b"old!")
        gateway.repeats = 2
        assert client.sdo_read(1001, 0x2000) == b"old!"
        other.sdo_write(1001, 0x2000, 0, b"new!")
        assert client.sdo_read(1001, 0x2000) == b"new!"


def test_frames_that_come_at_once_by_a_stream_are_taken_one_by_one(gateway) -> None:
    with GatewayClient("127.0.0.1", gateway.port, tcp=True, timeout_s=1) as client:
        assert client.idn_describe(1001, MODE).name == "Mode"
        assert client.od_list(1001) == [0x1008, 0x2000]
