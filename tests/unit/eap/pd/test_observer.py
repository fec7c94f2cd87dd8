"""Observer of a network: PDs, their senders and rhythms, odd frames, and bounded memory."""

from __future__ import annotations

import random
import tracemalloc

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.ethercat import EtherCatHeader
from eap.codec.pd import EAP_SM_OFFSET
from eap.pd.observer import ObservedPath, Observer
from eap.pd.rhythm import CycleOrder, swap
from eap.pd.words import Reason
from tests.support.cyclic import MS, PEER, octets

A, B = "10.0.0.1", "10.0.0.2"
TO_B = ObservedPath("udp", A, B)
GROUP = ObservedPath("ethernet", "02:00:00:00:00:01", "01:01:05:04:00:00", 7)


def observe(frames, path=TO_B, observer=None):
    observer = observer or Observer()
    for number, frame in enumerate(frames):
        observer.receive_frame(frame, number * 10 * MS, path)
    return observer


def the_pd(observer):
    (found,) = observer.pds.values()
    return found


def test_each_pd_of_a_frame_is_a_row_with_its_path():
    observer = observe([octets([(1, b"ab", 3, 20), (2, b"c")], cycle=n) for n in range(10)], GROUP)
    first, second = observer.pds.values()
    assert (str(first.publisher), first.key.pd_id, first.key.version) == (PEER, 1, 3)
    assert (first.key.length, first.key.destination, first.key.vlan_id) == (2, GROUP.destination, 7)
    assert (first.sources, first.quality, second.key.pd_id) == ([GROUP.source], 20, 2)
    assert first.measure().trigger is Reason.CYCLE
    assert (observer.frames, observer.malformed, observer.cut) == (10, 0, 0)


def test_same_pd_to_two_destinations_or_in_two_versions_is_told_apart():
    observer = observe([octets([(1, b"ab")])])
    observe([octets([(1, b"ab")])], GROUP, observer)
    observe([octets([(1, b"ab", 5)]), octets([(1, b"abc")])], TO_B, observer)
    assert len(observer.pds) == 4


def test_wrong_length_of_header_is_named_and_pds_are_found():
    frame = octets([(1, b"ab"), (2, b"cd")])
    short = EtherCatHeader(4).encode() + frame[2:]
    observer = observe([short.ljust(60, b"\0")] * 3)
    assert [pd.wrong_length for pd in observer.pds.values()] == [4, 4]
    assert (observer.wrong_length, observer.cut, observer.malformed) == (3, 0, 0)
    long = EtherCatHeader(900).encode() + frame[2:]
    assert the_pd(observe([EtherCatHeader(900).encode() + octets([(1, b"a")])[2:]])).wrong_length
    assert observe([long]).wrong_length == 1


def test_right_frames_with_padding_or_surplus_have_no_wrong_length():
    frame = octets([(1, b"ab")])
    surplus = EtherCatHeader(len(frame) + 3).encode() + frame[2:] + b"extra"
    observer = observe([frame, frame.ljust(60, b"\0"), surplus])
    assert (observer.wrong_length, the_pd(observer).wrong_length) == (0, None)


def test_cut_frame_still_shows_its_pds():
    frame = octets([(1, b"ab"), (2, bytes(1000)), (3, b"x")])
    observer = observe([frame[:200]])
    assert [key.pd_id for key in observer.pds] == [1, 2]
    # No guess rests on the begin of a PD.
    assert [pd.samples for pd in observer.pds.values()] == [[b"ab"], []]
    assert (observer.cut, observer.malformed) == (1, 0)


def test_pds_past_the_end_of_a_whole_frame_are_malformed():
    frame = bytearray(octets([(1, b"ab")]))
    frame[18] = 200  # the PD's length
    assert observe([bytes(frame)]).malformed == 1


def test_swapped_and_constant_counters_are_recognised():
    swapped = observe([octets([(1, b"a")], cycle=swap(n)) for n in range(20)])
    assert the_pd(swapped).cycle.order is CycleOrder.SWAPPED
    assert the_pd(swapped).measure().step == 1
    constant = observe([octets([(1, b"a")])] * 20)
    assert the_pd(constant).cycle.order is CycleOrder.CONSTANT


def with_state(cycle, state):
    frame = bytearray(octets([(1, b"a")], cycle=cycle))
    frame[EAP_SM_OFFSET] = state
    return bytes(frame)


def test_repeated_needs_same_counter_and_a_toggle_bit_that_toggles():
    sent = [(1, 0x28), (2, 0x08), (3, 0x28), (3, 0x28), (3, 0x08), (4, 0x28), (6, 0x28)]
    assert the_pd(observe([with_state(*each) for each in sent])).repeated == 1
    never = [(1, 0x08), (1, 0x08), (2, 0x08), (2, 0x08)]
    assert the_pd(observe([with_state(*each) for each in never])).repeated == 0


def test_answers_to_another_port_than_the_usual_are_polled():
    observer = Observer()
    for number in range(10):
        at_ns = number * 100 * MS
        observer.receive_frame(octets([(7, b"?")], cycle=number), at_ns, ObservedPath("udp", B, A))
        answer = ObservedPath("udp", A, f"{B}:40000")
        observer.receive_frame(octets([(8, b"!")], cycle=10 * number), at_ns + MS, answer)
    asked, answered = observer.pds.values()
    assert asked.measure().trigger is Reason.CYCLE
    assert answered.measure().trigger is Reason.POLL


def test_answers_to_regular_requests_have_uneven_steps_of_the_counter():
    observer = Observer()
    for number in range(20):
        at_ns = number * 44 * MS
        observer.receive_frame(octets([(7, b"?")], cycle=number), at_ns, ObservedPath("udp", B, A))
        observer.receive_frame(octets([(8, b"!")], cycle=at_ns // (10 * MS)), at_ns + MS, TO_B)
    asked, answered = observer.pds.values()
    assert asked.measure().trigger is Reason.CYCLE
    assert (answered.measure().trigger, answered.measure().step) == (Reason.POLL, 0)


def test_irregular_answers_of_a_host_are_polled_and_other_pds_are_not():
    observer, noise, at_ns = Observer(), random.Random(3), 0
    for number in range(30):
        at_ns += noise.randint(20, 900) * MS
        observer.receive_frame(
            octets([(7, b"?")], cycle=at_ns // MS), at_ns, ObservedPath("udp", B, A)
        )
        data = noise.randbytes(2)
        observer.receive_frame(octets([(8, data)], cycle=at_ns // MS), at_ns + 2 * MS, TO_B)
        if number % 3 == 0:
            observer.receive_frame(octets([(9, data)], cycle=number * number), at_ns + 3 * MS, TO_B)
    triggers = {key.pd_id: pd.measure().trigger for key, pd in observer.pds.items()}
    assert triggers[8] is Reason.POLL
    assert triggers[9] is not Reason.POLL


def test_other_types_are_counted_by_type():
    frames = [EtherCatHeader(21, type=kind).encode() + bytes(21) for kind in (1, 5, 7, 7)]
    assert observe(frames).other_types == {1: 1, 5: 1, 7: 2}


def test_flood_of_publishers_does_not_push_out_those_that_send_again():
    observer = Observer(limit=50)
    real = [octets([(n, b"ab")], publisher=f"5.5.5.{n}.1.1") for n in range(10)]
    for frame in real * 2:
        observer.receive_frame(frame, 0, TO_B)
    noise = random.Random(1)
    for number in range(2000):
        forged = ".".join(str(noise.randrange(256)) for _ in range(6))
        observer.receive_frame(octets([(number, b"x")], publisher=forged), number, TO_B)
    assert len(observer.pds) == 50
    assert observer.not_kept == 2000 - 40
    for frame in real:
        observer.receive_frame(frame, 0, TO_B)
    assert [pd.rhythm.received for pd in list(observer.pds.values())[:10]] == [3] * 10


def test_full_table_of_senders_counts_further_ones():
    observer = Observer(limit=2)
    for frame in [octets([(1, b""), (2, b"")])] * 2 + [octets([(3, b"")])]:
        observer.receive_frame(frame, 0, TO_B)
    assert (len(observer.pds), observer.not_kept) == (2, 1)


def test_memory_is_bounded():
    observer, noise = Observer(limit=500), random.Random(2)
    tracemalloc.start()
    try:
        for number in range(6000):
            publisher = f"9.9.9.{number % 400 // 256}.{number % 256}.1"
            data = noise.randbytes(1400)
            path = ObservedPath("udp", f"10.1.{number % 256}.{number // 256}", B)
            observer.receive_frame(octets([(1, data)], publisher=publisher), number, path)
        assert tracemalloc.get_traced_memory()[0] < 40 << 20
    finally:
        tracemalloc.stop()


@given(st.binary(max_size=200), st.integers(0, 1 << 60))
def test_no_frame_raises(data, at_ns):
    observer = Observer()
    observer.receive_frame(data, at_ns, TO_B)
    observer.receive_frame(b"\x20\x40" + data, at_ns, TO_B)
    for pd in observer.pds.values():
        pd.measure()


@pytest.mark.parametrize("size", range(45))
def test_every_prefix_of_a_frame_is_taken_or_counted(size):
    frame = octets([(1, b"ab"), (2, b"cde")])
    observer = observe([frame[:size]])
    assert observer.frames + observer.malformed == 1
