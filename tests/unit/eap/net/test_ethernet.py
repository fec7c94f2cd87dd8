"""The Ethernet driver on a veth pair: addresses, VLANs, neighbours on the same interface."""

from __future__ import annotations

import contextlib
import socket
import struct
import time

import pytest

from eap.compiled import cyclic
from eap.ids import MacAddr
from eap.net.ethernet import EthernetInterface, packet_batch
from eap.net.packetsocket import open_packet_pair
from eap.pd.link import OutFrame
from tests.unit.eap.net.conftest import ip, wait_for_links

pytestmark = [pytest.mark.net, pytest.mark.root]
needs_compiled = pytest.mark.skipif(cyclic is None, reason="needs the compiled part: make setup")

GROUP = "01:01:05:04:00:00"
OTHER_GROUP = "01:01:05:04:00:77"


class Listener:
    """A station's side of a port."""

    def __init__(self, interface, **options):
        self.got = []
        self.times = []
        self.senders = []
        self.sources = []
        self.for_many = []
        self.port = interface.port(self.take, **options)

    def take(self, data, size, at_ns, origin):
        self.got.append(bytes(data[: min(size, 3)]))
        self.times.append(at_ns)
        self.senders.append(origin.sender_of(data))
        self.sources.append(MacAddr(origin.source_of(data)))
        self.for_many.append(origin.is_group_frame(data))

    def drain(self, count):
        """Drain until *count* frames have been taken: under load they come a little later."""
        limit = time.monotonic() + 5
        while len(self.got) < count:
            assert time.monotonic() < limit, self.got
            self.port.drain(0)
        return self.got

    def frame(self, number, destination=GROUP):
        header = self.port.link_header(destination)
        body = bytes([number, 0x40, number]).ljust(self.port.minimum_size - len(header), b"\0")
        return OutFrame(bytearray(header + body), len(header), destination)


def expect(number):
    return bytes([number, 0x40, number])


@pytest.fixture
def ends(cable):
    """The engine's interfaces at both ends of a cable."""
    with contextlib.ExitStack() as stack:
        batch = packet_batch()
        found = []
        for name in cable:
            engine, services = open_packet_pair(name)
            stack.callback(services.close)
            found.append(EthernetInterface(engine, batch))
            stack.callback(found[-1].close)
        yield found


@pytest.fixture
def raw(cable):
    """A plain socket on the right end, for frames that no port of ours would send."""
    with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0) as sock:
        sock.bind(("right", 0))
        yield sock


def raw_frame(number, destination=GROUP, *, tag=b"", ethertype=b"\x88\xa4", frame_type=4):
    head = bytes.fromhex(destination.replace(":", "")) + bytes.fromhex("020000000099")
    body = bytes([number, frame_type << 4, number])
    return (head + tag + ethertype + body).ljust(60, b"\0")


def vlan(vid, priority=0):
    return struct.pack("!HH", 0x8100, priority << 13 | vid)


@pytest.mark.parametrize("count", [1, 3, 64, 100])
def test_frames_cross_the_cable(ends, count):
    sender, receiver = Listener(ends[0]), Listener(ends[1])
    before = time.monotonic_ns()
    frames = [sender.frame(n) for n in range(count)]
    assert sender.port.send(frames, 0) == ()
    assert receiver.drain(count) == [expect(n) for n in range(count)]
    assert receiver.times == sorted(receiver.times)
    assert before - 5_000_000 < receiver.times[0] < time.monotonic_ns()
    assert sender.got == []
    assert sender.port.drain(0) == 0


def test_unicast_broadcast_and_joined_groups_are_taken(ends, raw):
    receiver = Listener(ends[0], join=[OTHER_GROUP])
    own, foreign = str(ends[0].address), "02:00:00:00:00:55"
    for number, mac in enumerate([own, "ff:ff:ff:ff:ff:ff", OTHER_GROUP]):
        raw.send(raw_frame(number, mac))
    for mac in (foreign, "01:01:05:04:00:78"):
        raw.send(raw_frame(99, mac))
    raw.send(raw_frame(3))
    assert receiver.drain(4) == [expect(n) for n in range(4)]
    assert receiver.for_many == [False, True, True, True]


def test_ethernet_group_reaches_only_ports_that_joined(ends, raw):
    joined, other = Listener(ends[0], join=[OTHER_GROUP]), Listener(ends[0])
    raw.send(raw_frame(1, OTHER_GROUP))
    raw.send(raw_frame(2))
    assert joined.drain(2) == [expect(1), expect(2)]
    assert other.got == [expect(2)]


def test_untagged_and_priority_tagged_are_one_network(ends, raw):
    receiver = Listener(ends[0])
    raw.send(raw_frame(1))
    raw.send(raw_frame(3, tag=vlan(10)))
    raw.send(raw_frame(2, tag=vlan(0, priority=5)))
    assert receiver.drain(2) == [expect(1), expect(2)]
    assert ends[0].discarded["other_vlan"] == 1


def test_port_of_a_vlan_takes_only_that(ends, raw):
    tagged, untagged = Listener(ends[0], vlan_id=10), Listener(ends[0])
    raw.send(raw_frame(1))
    raw.send(raw_frame(3, tag=vlan(11)))
    raw.send(raw_frame(2, tag=vlan(10, priority=6)))
    assert tagged.drain(1) == [expect(2)]
    assert untagged.got == [expect(1)]
    assert ends[0].discarded["other_vlan"] == 1


@pytest.mark.parametrize(
    ("vid", "priority", "header"),
    [
        (0, 0, "88a4"),
        (10, 0, "8100000a88a4"),
        (10, 6, "8100c00a88a4"),
        (0, 7, "8100e00088a4"),
    ],
)
def test_frames_leave_with_the_tag_of_their_port(ends, vid, priority, header):
    sender = Listener(ends[0], vlan_id=vid, priority=priority)
    receiver = Listener(ends[1], vlan_id=vid)
    frame = sender.frame(1)
    start = bytes.fromhex(GROUP.replace(":", "")) + ends[0].address
    assert bytes(frame.buffer[: frame.headroom]) == start + bytes.fromhex(header)
    sender.port.send([frame], 0)
    assert receiver.drain(1) == [expect(1)]


def test_kernel_sorts_by_type_and_drops_foreign_protocols(cable, raw):
    pair = open_packet_pair("left")
    try:
        raw.send(raw_frame(99, ethertype=b"\x08\x00"))
        raw.send(raw_frame(98, "02:00:00:00:00:55"))
        for n in range(16):
            raw.send(raw_frame(n, frame_type=n))
        for sock, types in zip(pair, ({*range(16)} - {2, 3, 5}, {2, 3, 5}), strict=True):
            sock.settimeout(5)
            got = {sock.recv(100)[14] for _ in types}
            assert got == types
            sock.setblocking(False)
            with pytest.raises(BlockingIOError):
                sock.recv(100)
    finally:
        for sock in pair:
            sock.close()


def test_ports_of_one_interface_hear_each_other(ends):
    first, second, third = (Listener(ends[0]) for _ in range(3))
    tagged = Listener(ends[0], vlan_id=10)
    far = Listener(ends[1])
    frames = [first.frame(1), first.frame(2, str(ends[0].address)), first.frame(3, OTHER_GROUP)]
    first.port.send(frames, 777)
    frames[0].view[-1] = 0xEE  # what was sent does not change any more
    assert second.port.drain(0) == 4
    assert second.got == third.got == [expect(1), expect(2)]
    assert second.times == [777, 777]
    assert first.got == tagged.got == []
    assert far.drain(1) == [expect(1)]


@needs_compiled
def test_frames_are_sent_directly_unless_others_hear_them_or_their_port_mends_them(ends):
    near, far = Listener(ends[0]), Listener(ends[1])
    assert near.port.direct.may_send
    other = Listener(ends[0], vlan_id=10)
    assert not near.port.direct.may_send
    ends[0].remove(other.port)
    assert near.port.direct.may_send
    near.port.readdress()
    assert not near.port.direct.may_send
    assert far.port.direct.may_send


@needs_compiled
def test_python_drains_while_frames_of_the_own_host_wait(ends):
    first, second = Listener(ends[0]), Listener(ends[0])
    first.port.send([first.frame(1)], 7)
    assert not ends[0].compiled.may_drain
    assert second.port.drain(0) == 1
    assert ends[0].compiled.may_drain


def test_exchanged_handler_takes_the_frames_of_the_other_and_none_of_its_own_port(ends):
    first, second = (Listener(ends[0]) for _ in range(2))
    far = Listener(ends[1])
    plain, seen = first.port.handler, []

    def tapped(data, size, at_ns, origin):
        seen.append(bytes(data[:3]))
        plain(data, size, at_ns, origin)

    first.port.exchange_handler(plain, tapped)
    second.port.send([second.frame(1)], 0)
    first.port.send([first.frame(2)], 0)
    far.port.send([far.frame(3)], 0)
    assert first.drain(2) == [expect(1), expect(3)]
    assert seen == first.got
    first.port.exchange_handler(tapped, plain)
    second.port.send([second.frame(4)], 0)
    assert first.drain(3)[-1] == expect(4)
    assert len(seen) == 2


def test_neighbours_that_are_never_drained_do_not_fill_the_memory(ends):
    sender = Listener(ends[0])
    Listener(ends[0])
    frame = sender.frame(1)
    for _ in range(1030):
        sender.port.send((frame,), 0)
    assert ends[0].discarded["local_overflow"] == 6
    assert sender.port.drain(0) == 1024


def test_interface_that_goes_down_is_counted_and_comes_back(ends):
    sender, receiver = Listener(ends[0]), Listener(ends[1])
    neighbour = Listener(ends[0])
    ip("link set left down")
    frames = [sender.frame(1), sender.frame(2)]
    assert list(sender.port.send(frames, 0)) == frames
    assert ends[0].errors["ENETDOWN"] == 2
    sender.port.drain(0)
    assert neighbour.got == []
    ip("link set left up")
    wait_for_links("left", "right")
    assert sender.port.send(frames, 0) == ()
    assert receiver.drain(2) == [expect(1), expect(2)]


def test_drain_is_bounded(ends):
    sender, receiver = Listener(ends[0]), Listener(ends[1])
    frame = sender.frame(1)
    for _ in range(300):
        sender.port.send((frame,), 0)
    assert receiver.port.drain(0) <= 256
    receiver.drain(300)
    assert sender.port.fileno() == ends[0].fileno()


def test_an_answer_goes_to_the_mac_address_that_asked(ends, raw):
    client, server, idle = Listener(ends[0]), Listener(ends[1]), Listener(ends[1])
    for count in (1, 2):
        client.port.send([client.frame(n) for n in range(count)], 0)
        server.drain(len(server.got) + count)
        assert server.senders[-count:] == [str(ends[0].address)] * count
        assert server.sources[-count:] == [ends[0].address] * count
    server.port.send([server.frame(7, server.senders[0])], 0)
    assert client.drain(1) == [expect(7)]
    assert expect(7) not in idle.got


def test_neighbours_on_one_interface_answer_each_other(ends):
    client, server = Listener(ends[0]), Listener(ends[0])
    client.port.send([client.frame(1)], 0)
    server.drain(1)
    server.port.send([server.frame(2, server.senders[0])], 0)
    assert client.drain(1) == [expect(2)]


def test_ethernet_group_is_no_sender(ends, raw):
    server = Listener(ends[0])
    head = bytes.fromhex("010105040000 010105040000 88a4")
    raw.send((head + bytes([1, 0x40, 1])).ljust(60, b"\0"))
    server.drain(1)
    assert server.senders == [""]


def test_a_frame_above_the_mtu_is_refused_as_too_large(ends):
    sender = Listener(ends[0])
    ip("link set left mtu 500")
    frame = sender.frame(1)
    large = OutFrame(bytearray(frame.buffer.ljust(600, b"\0")), 14, GROUP)
    assert list(sender.port.send([frame, large], 0)) == [large]
    assert (frame.oversized, large.oversized) == (False, True)


def make_again(left_mac, right_mac):
    """Delete the cable and lay another one, whose ends have other addresses."""
    ip("link del left")
    ip(f"link add left address {left_mac} type veth peer name right address {right_mac}")
    ip("link set left up")
    ip("link set right up")
    wait_for_links("left", "right")


def look_until(condition, *listeners):
    limit = time.monotonic() + 5
    while not condition():
        assert time.monotonic() < limit
        for each in listeners:
            each.port.drain(0)


def test_interface_made_again_is_found_and_frames_have_its_address(ends):
    near, far = Listener(ends[0], join=[OTHER_GROUP]), Listener(ends[1], join=[OTHER_GROUP])
    prebuilt = near.frame(1), far.frame(2)
    near.port.drain(0)
    far.port.drain(0)
    make_again("02:00:00:00:00:11", "02:00:00:00:00:22")
    look_until(lambda: [str(end.address)[-2:] for end in ends] == ["11", "22"], near, far)
    assert near.port.send(prebuilt[:1], 0) == ()
    assert far.drain(1) == [expect(1)]
    assert [str(mac) for mac in far.sources] == ["02:00:00:00:00:11"]
    assert far.port.send([prebuilt[1], far.frame(3, OTHER_GROUP)], 0) == ()
    assert near.drain(2) == [expect(2), expect(3)]
    assert {str(mac) for mac in near.sources} == {"02:00:00:00:00:22"}
    assert near.port.send([near.frame(4, "02:00:00:00:00:22")], 0) == ()
    assert far.drain(2)[1] == expect(4)
    assert far.for_many == [True, False]


def test_interface_only_switched_off_keeps_its_frames(ends):
    near, far = Listener(ends[0]), Listener(ends[1])
    prebuilt = near.frame(1)
    ip("link set left down")
    near.port.drain(0)
    assert near.port.send([prebuilt], 0) == [prebuilt]
    ip("link set left up")
    wait_for_links("left", "right")
    look_until(lambda: near.port.send([prebuilt], 0) == (), near)
    assert far.drain(1) == [expect(1)]
    assert far.sources == [ends[0].address]


def test_interface_away_at_start_is_found_by_its_name(cable):
    engine, services = open_packet_pair("left")
    ip("link del left")
    interface = EthernetInterface(engine, packet_batch(), "left")
    try:
        near = Listener(interface)
        frame = near.frame(1)
        assert near.port.send([frame], 0) == [frame]
        ip("link add left address 02:00:00:00:00:11 type veth peer name right")
        ip("link set left up")
        ip("link set right up")
        wait_for_links("left", "right")
        look_until(lambda: str(interface.address)[-2:] == "11", near)
        with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0x0300) as other:
            other.bind(("right", 0x0003))
            other.settimeout(5)
            assert near.port.send([frame], 0) == ()
            while (data := other.recv(2000))[12:14] != b"\x88\xa4":
                pass
            assert data[6:12] == bytes(interface.address)
    finally:
        interface.close()
        services.close()
