from __future__ import annotations

import pytest

from devicebus.mailbox import eoe_switch
from devicebus.mailbox.eoe import FrameAssembler
from devicebus.mailbox.eoe_switch import HOST, EthernetSwitch, send_frame
from devicebus.mailbox.protocol import MailboxSizes
from eap.errors import CodecError

A, B, C, X = (bytes((2, 0, 0, 0, 0, number)) for number in range(4))
ALL = b"\xff" * 6
GROUP = bytes.fromhex("01005e000001")


def frame(target: bytes, source: bytes, size: int = 64) -> bytes:
    return (target + source).ljust(size, b"\x42")


class Ports:
    """A switch with three ports; A is behind the host, B and C are slaves."""

    def __init__(self) -> None:
        self.notified: list[int] = []
        self.switch = EthernetSwitch(self.notified.append)
        for port in (HOST, 1001, 1002):
            self.switch.connect(port)

    def send(self, port: int, data: bytes, now_ns: int = 0) -> list[int]:
        """Send a frame; return the ports that it goes out by."""
        self.notified.clear()
        self.switch.receive_frame(port, data, now_ns)
        return list(self.notified)


@pytest.fixture
def ports() -> Ports:
    return Ports()


def test_switch_floods_unknown_addresses_and_learns_them(ports):
    assert ports.send(HOST, frame(B, A)) == [1001, 1002]
    assert ports.send(1001, frame(A, B)) == [HOST]
    assert ports.send(HOST, frame(B, A)) == [1001]
    assert ports.send(1002, frame(B, C)) == [1001]  # from slave to slave
    for group in (ALL, GROUP):
        assert ports.send(1001, frame(group, B)) == [HOST, 1002]
    assert ports.switch.addresses(1002, 0) == [C]


def test_switch_keeps_frames_between_hosts_behind_one_port_there(ports):
    ports.send(1001, frame(ALL, B))
    ports.send(1001, frame(ALL, X))
    assert ports.send(1001, frame(X, B)) == []


def test_switch_follows_a_host_that_moves_and_forgets_silent_ones(ports):
    ports.send(1001, frame(ALL, B))
    ports.send(1002, frame(ALL, B))
    assert ports.send(HOST, frame(B, A)) == [1002]
    late_ns = eoe_switch.AGEING_NS
    assert ports.send(HOST, frame(B, A), late_ns) == [1001, 1002]
    assert ports.switch.addresses(1002, late_ns) == []


def test_switch_learns_no_group_address_as_source(ports):
    ports.send(1001, frame(ALL, GROUP))
    assert ports.send(HOST, frame(GROUP, A)) == [1001, 1002]


def test_switch_limits_learned_addresses(ports, monkeypatch):
    monkeypatch.setattr(eoe_switch, "MAX_ADDRESSES", 2)
    for source in (A, B, A, C):
        ports.send(1001, frame(ALL, source))
    assert ports.switch.addresses(1001, 0) == [A, C]


def test_switch_disconnects_a_port_with_what_waits_there(ports):
    ports.send(1001, frame(ALL, B))
    ports.send(HOST, frame(B, A))
    ports.switch.disconnect(1001)
    assert ports.switch.take_frame(1001) is None
    assert ports.send(HOST, frame(B, A)) == [1002]
    ports.switch.connect(1001)
    assert ports.send(HOST, frame(B, A)) == [1001, 1002]


def test_switch_drops_and_counts_what_does_not_fit(ports):
    for size in (0, 13, 1523):
        assert ports.send(1001, frame(ALL, B, size)[:size]) == []
    for _ in range(eoe_switch.MAX_QUEUED + 5):
        ports.send(HOST, frame(ALL, A))
    ports.switch.count_invalid(1002, 2)
    counters = ports.switch.counters(1001)
    assert (counters.invalid, counters.dropped, counters.sent) == (3, 5, 0)
    assert ports.switch.counters(1002).invalid == 2
    assert ports.switch.counters(HOST).received == eoe_switch.MAX_QUEUED + 5
    while ports.switch.take_frame(1001) is not None:
        pass
    assert ports.switch.counters(1001).sent == eoe_switch.MAX_QUEUED
    assert ports.switch.counters(9).received == 0


def test_short_frame_is_padded_to_the_ethernet_minimum(ports):
    ports.send(HOST, frame(B, A, 42))
    assert ports.switch.take_frame(1001) == frame(B, A, 42).ljust(60, b"\0")


@pytest.mark.parametrize(("size", "count"), [(1024, 2), (64, 48), (42, 48)])
def test_frame_goes_to_a_slave_in_fragments_without_replies(size, count):
    data = frame(B, A, 1514)
    requests = list(send_frame(data, 15, MailboxSizes(size, size)))
    assert len(requests) == count
    assert not any(each.expects_reply for each in requests)
    assert all(len(each.request) + 6 <= size for each in requests)
    assembler = FrameAssembler()
    assert [assembler.receive(each.request) for each in requests][-1] == data


def test_frame_for_a_mailbox_that_is_too_small_is_refused():
    with pytest.raises(CodecError, match="at least 32"):
        list(send_frame(frame(B, A), 0, MailboxSizes(40, 40)))
