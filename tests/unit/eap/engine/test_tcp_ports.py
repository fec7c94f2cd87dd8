"""TCP at the ports of a station that changes while it runs."""

from __future__ import annotations

import select
import socket

import pytest
from msgspec.structs import replace

from eap.codec.pd import decode_frame_header
from eap.engine.successor import EngineStation, Successor
from eap.engine.tcp_ports import has_tcp, sends_to
from eap.ids import InterfaceUri
from eap.net.image_file import create_image
from eap.net.loopback import LoopbackLines
from eap.pd.engine import Engine
from eap.pd.layout import plan_layout
from eap.pd.spec import REQUESTER, TxFrameSpec, TxPdSpec
from eap.pd.station import Station
from tests.unit.eap.conftest import eap_port, left

pytestmark = pytest.mark.net

HERE = "127.9.2.31"


def sending(*destinations):
    frames = tuple(
        TxFrameSpec(f"f{n}", "eap0", where, (TxPdSpec(f"p{n}", n, ("running",)),))
        for n, where in enumerate(destinations)
    )
    return replace(left(eap_port(31)), frames=frames)


def test_a_port_has_tcp_when_it_sends_takes_or_is_made_of_it():
    udp = eap_port(31)
    assert sends_to(sending("127.9.2.2", "tcp://127.9.2.3", REQUESTER), "eap0") == {
        "tcp://127.9.2.3"
    }
    assert sends_to(sending("tcp://127.9.2.3"), "eap1") == set()
    assert [has_tcp(sending("127.9.2.2"), port) for port in (udp, replace(udp, tcp=True))] == [
        False,
        True,
    ]
    assert has_tcp(sending("127.9.2.2"), eap_port(31, "tcp://127.9.2.31"))
    assert has_tcp(sending("tcp://127.9.2.3"), udp)


@pytest.fixture
def listeners():
    """Two that take connections."""
    made = [socket.create_server(("127.9.2.32", 0)) for _ in range(2)]
    yield made
    for each in made:
        each.close()


def test_destinations_by_tcp_come_and_go_while_the_station_runs(tmp_path, listeners):
    first, second = ("tcp://{}:{}".format(*listener.getsockname()) for listener in listeners)
    spec = sending("127.9.2.2")
    file = create_image(tmp_path / "left.image", plan_layout(spec))
    station = Station(spec, file.image, file.wake_waiters)
    station.connect("eap0", LoopbackLines().open(InterfaceUri.parse("loop://x")))
    place = EngineStation(station, file)
    engine = Engine([station])
    engine.start(0)

    def configure(*destinations):
        Successor(place, sending(*destinations)).take_over(engine, engine.next_timeout())
        place.settle_tcp()

    def accept(listener):
        while not select.select([listener], [], [], 0)[0]:
            engine.handle_timeout(engine.next_timeout())
        connection, _ = listener.accept()
        connection.setblocking(False)
        return connection

    def receive(connection):
        while not select.select([connection], [], [], 0)[0]:
            engine.handle_timeout(engine.next_timeout())
        return connection.recv(1 << 16)

    configure("127.9.2.2", first)
    with accept(listeners[0]) as one:
        assert decode_frame_header(receive(one)).count == 1
        configure(first, second)
        with accept(listeners[1]) as two:
            assert receive(two)
            assert receive(one)  # still the same connection
            configure(second)
            while receive(one):
                pass  # and then it has been closed
            assert receive(two)
            configure("127.9.2.2")
            while receive(two):
                pass
    place.close()
    assert file.path.name == "left.image"
