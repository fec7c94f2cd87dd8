from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.ethercat import EtherCatHeader
from eap.recording.packets import Stream, TcpSegment, cut_frames, unwrap
from tests.support.packets import ethernet, tcp_segment, tcp_stream, udp

FRAME = bytes.fromhex("0240abcd")
frames = st.lists(
    st.binary(max_size=40).map(lambda body: EtherCatHeader(len(body)).encode() + body), max_size=8
)


def test_unwrap_takes_ethernet_headers_off() -> None:
    packet = unwrap(ethernet(FRAME))
    assert packet is not None
    assert packet.payload.startswith(FRAME)
    assert packet[:4] == ("ethernet", "02:01:05:00:00:01", "01:01:05:04:00:00", None)


@pytest.mark.parametrize(("tag", "vlan_id"), [(0xE000, 0), (0x2005, 5)])
def test_unwrap_takes_vlan_tags_off(tag: int, vlan_id: int) -> None:
    packet = unwrap(ethernet(FRAME, vlan=tag))
    assert packet is not None
    assert packet.payload.startswith(FRAME)
    assert packet.vlan_id == vlan_id


def test_udp_in_both_directions() -> None:
    request, reply = unwrap(udp(FRAME, source_port=40000)), unwrap(udp(FRAME, port=40000))
    assert request is not None
    assert reply is not None
    assert request[:3] == ("udp", "127.0.1.2:40000", "127.0.1.1:34980")
    assert reply[:3] == ("udp", "127.0.1.2:34980", "127.0.1.1:40000")
    assert request.payload == reply.payload == FRAME


def test_padding_behind_an_ip_packet_is_not_payload() -> None:
    packet = unwrap(udp(b"") + bytes(18))
    assert packet is not None
    assert packet.payload == b""


def test_unwrap_takes_tcp_headers_off() -> None:
    packet = unwrap(tcp_segment(FRAME, 77))
    assert packet is not None
    assert (packet.payload, packet.segment) == (FRAME, TcpSegment(77, is_first=False))
    opening = unwrap(tcp_segment(b"", 77, flags=0x02))
    assert opening is not None
    assert opening.segment == TcpSegment(77, is_first=True)


def changed(octets: bytes, position: int, value: int) -> bytes:
    copy = bytearray(octets)
    copy[position] = value
    return bytes(copy)


@pytest.mark.parametrize(
    "octets",
    [
        b"",
        ethernet(FRAME)[:13],
        ethernet(FRAME, ethertype=0x86DD),
        ethernet(FRAME, vlan=5)[:15],
        udp(FRAME, source_port=1, port=2),
        udp(FRAME)[:33],
        udp(FRAME)[:41],
        tcp_segment(FRAME, 0)[:53],
        changed(udp(FRAME), 14, 0x65),
        changed(udp(FRAME), 21, 1),
        changed(udp(FRAME), 23, 1),
    ],
    ids=[
        "empty",
        "short",
        "foreign type",
        "short tag",
        "foreign port",
        "short IP",
        "short UDP",
        "short TCP",
        "IPv6",
        "later fragment",
        "ICMP",
    ],
)
def test_unwrap_of_other_packets_yields_nothing(octets: bytes) -> None:
    assert unwrap(octets) is None


@given(st.binary(max_size=80), st.sampled_from((ethernet, udp, lambda n: tcp_segment(n, 0))))
def test_any_octets_are_taken(noise: bytes, wrap: object) -> None:
    unwrap(noise)
    for cut in range(0, 60, 7):
        unwrap(wrap(noise)[:cut])


@given(frames, st.binary(max_size=1))
def test_frames_are_cut_off_the_front(items: list[bytes], rest: bytes) -> None:
    stream = bytearray(b"".join(items) + rest)
    assert list(cut_frames(stream)) == items
    assert stream == rest


def feed(stream: Stream, packets: list[bytes]) -> list[bytes]:
    found = []
    for octets in packets:
        packet = unwrap(octets)
        assert packet is not None
        if packet.destination.endswith(":34980"):
            found += stream.receive(packet.segment, packet.payload)
    return found


@given(
    frames,
    st.lists(st.integers(0, 300), max_size=10),
    st.sampled_from((1000, 2**32 - 20)),
    st.randoms(use_true_random=False),
)
def test_segments_in_any_order_and_twice_give_the_same_frames(
    items: list[bytes], cuts: list[int], start: int, random: object
) -> None:
    opening, *packets = tcp_stream(items, cuts=cuts, start=start)
    packets += packets[::2]
    random.shuffle(packets)
    stream = Stream()
    assert feed(stream, [opening, *packets]) == items
    assert list(stream.flush()) == []


def test_retransmission_that_overlaps_is_cut() -> None:
    stream = Stream()
    assert feed(stream, [tcp_segment(FRAME[:2], 10)]) == []
    assert feed(stream, [tcp_segment(FRAME + FRAME[:1], 10)]) == [FRAME]
    assert feed(stream, [tcp_segment(FRAME[:2], 10), tcp_segment(FRAME[1:], 15)]) == [FRAME]


def test_lost_segment_costs_its_frames_only() -> None:
    stream = Stream()
    assert feed(stream, [tcp_segment(FRAME + FRAME[:3], 0), tcp_segment(FRAME, 9)]) == [FRAME]
    assert list(stream.flush()) == [FRAME[:3], FRAME]


def test_capture_does_not_wait_for_a_lost_segment_for_ever() -> None:
    stream = Stream()
    assert feed(stream, [tcp_segment(FRAME[:3], 0)]) == []
    packets = [tcp_segment(FRAME, 4 + 4 * n) for n in range(65)]
    assert feed(stream, packets) == [FRAME[:3], *[FRAME] * 65]


def test_new_connection_gives_up_what_the_old_one_began() -> None:
    stream = Stream()
    packets = [tcp_segment(FRAME[:3], 0), tcp_segment(b"", 900, flags=2), tcp_segment(FRAME, 901)]
    assert feed(stream, packets) == [FRAME[:3], FRAME]
