"""Signed frames: what is sent, what is accepted, and what each fault does to data and counters."""

from __future__ import annotations

import hashlib
import hmac

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.pd import CYCLE_OFFSET, EAP_SM_OFFSET, FIRST_PD, PD_FRAME_START, PdHeader, iter_pds
from eap.pd.authentication import (
    SIGNATURE_ID,
    SIGNATURE_SIZE,
    SIGNED_BYTES,
    TAG_SIZE,
    KeyRing,
    Keys,
    SigningChannel,
    read_signature,
)
from eap.pd.link import OutFrame
from eap.pd.spec import Authentication, RxPdSpec
from eap.pd.words import RxWord
from tests.support.cyclic import MS, PEER, Receiver, octets, received

KEY, OTHER_KEY = bytes(range(32)), bytes(32)
NOW = 1_000 * MS
SIGNATURE = PdHeader.SIZE + SIGNATURE_SIZE


class Line:
    """A channel that keeps what is sent."""

    minimum_size = 0
    drain = exchange_handler = link_header = None

    def __init__(self) -> None:
        self.sent: list[bytes] = []

    def send(self, frames, now_ns):
        self.sent += [bytes(frame.view[frame.headroom :]) for frame in frames]
        return []


def signed(data: bytes = b"ab", *, keys: KeyRing, cycle: int = 1, headroom: int = 0) -> bytes:
    """A frame with PD 7 and a signature, as a publisher sends it."""
    frame = octets([(7, data, 3), (SIGNATURE_ID, bytes(SIGNATURE_SIZE), 1)], cycle=cycle)
    out = OutFrame(bytearray(bytes(headroom) + frame), headroom, "", len(frame) - SIGNATURE_SIZE)
    line = Line()
    SigningChannel(line, keys).send([out], NOW)
    return line.sent[0]


def ring(key: bytes = KEY, number: int = 1) -> KeyRing:
    return KeyRing(Keys({number: key}, number))


def receiver(auth: Authentication, keys: KeyRing | None = None) -> Receiver:
    pd = RxPdSpec("r", "eap0", 7, ("x",), PEER, version=3, auth=auth)
    return Receiver(pd, variables=received("x:UINT"), keys=keys or ring())


def taken(r: Receiver) -> int:
    return r.word("r", RxWord.RECEIVED)


@pytest.mark.parametrize("headroom", [0, 14, 18])
def test_signature_is_the_hmac_of_all_before_it(headroom):
    frame = signed(keys=ring(), headroom=headroom)
    tag = frame[-TAG_SIZE:]
    whole = hmac.new(KEY, frame[PD_FRAME_START:-TAG_SIZE], hashlib.sha256).digest()
    assert tag == whole[:TAG_SIZE]
    (_, data), (header, signature) = iter_pds(frame)
    assert bytes(data) == b"ab"
    assert (header.pd_id, header.version, header.length) == (65534, 1, 28)
    assert read_signature(header.pd_id, header.version, bytes(signature)) == (1, NOW)


def test_counter_follows_the_clock_and_always_rises():
    keys = KeyRing(Keys({1: KEY}, 1), epoch_offset_ns=5)
    counters = [read_signature(SIGNATURE_ID, 1, signed(keys=keys)[-28:]).counter for _ in range(3)]
    assert counters == [NOW + 5, NOW + 6, NOW + 7]
    keys.epoch_offset_ns = -NOW  # the clock was set back
    assert read_signature(SIGNATURE_ID, 1, signed(keys=keys)[-28:]).counter == NOW + 8


@pytest.mark.parametrize("auth", list(Authentication))
def test_right_signature_is_accepted_and_counts_nothing(auth):
    r, keys = receiver(auth), ring()
    for cycle in (1, 2, 3):
        r.give(signed(cycle.to_bytes(2, "little"), keys=keys, cycle=cycle), cycle * MS)
        assert r.image.read("x") == cycle
    assert taken(r) == 3
    assert r.discarded() == {}


CHANGED_AT = (PD_FRAME_START, CYCLE_OFFSET, EAP_SM_OFFSET, FIRST_PD + 6, FIRST_PD + 8, -28, -24, -1)
"""Publisher, cycle, EAP SM, quality, data; key, counter, tag."""


@pytest.mark.parametrize(
    ("frames", "reason"),
    [
        ([octets([(7, b"ab", 3)], cycle=1), octets([(7, b"ab", 3)], cycle=2)], "unsigned"),
        ([signed(keys=ring(OTHER_KEY)), signed(keys=ring(OTHER_KEY), cycle=2)], "bad_tag"),
        ([signed(keys=ring(KEY, 2)), signed(keys=ring(KEY, 2), cycle=2)], "bad_tag"),
        ([signed(keys=KeyRing()), signed(keys=KeyRing(), cycle=2)], "bad_tag"),
    ],
)
def test_frames_without_a_right_signature_are_counted_and_refused_where_required(frames, reason):
    for auth, count in ((Authentication.REQUIRED, 0), (Authentication.COUNT, 2)):
        r = receiver(auth)
        for number, frame in enumerate(frames, 1):
            r.give(frame, number * MS)
        assert taken(r) == count
        assert r.image.read("x") == (int.from_bytes(b"ab", "little") if count else 0)
        assert r.discarded() == {reason: 2}
        assert r.discarded("r") == {reason: 2}
    r = receiver(Authentication.OFF)
    for number, frame in enumerate(frames, 1):
        r.give(frame, number * MS)
    assert (taken(r), r.discarded()) == (2, {})


@pytest.mark.parametrize("at", CHANGED_AT)
def test_each_changed_byte_is_noticed(at):
    r = receiver(Authentication.REQUIRED)
    frame = bytearray(signed(keys=ring()))
    frame[at] ^= 1
    r.give(bytes(frame), MS)
    assert taken(r) == 0
    assert r.image.read("x") == 0
    assert set(r.discarded("r")) <= {"bad_tag", "wrong_publisher"}
    assert r.discarded("r")


def test_repeated_frames_and_older_ones_are_replays():
    r, keys = receiver(Authentication.REQUIRED), ring()
    first, second = signed(b"ab", keys=keys, cycle=1), signed(b"cd", keys=keys, cycle=2)
    for number, frame in enumerate((first, second, second, first), 1):
        r.give(frame, number * MS)
    assert r.image.read("x") == int.from_bytes(b"cd", "little")
    assert taken(r) == 2
    assert r.discarded("r") == {"replayed": 2}


def test_replays_are_known_after_a_restart_of_the_engine():
    keys = ring()
    r = receiver(Authentication.REQUIRED)
    frame = signed(keys=keys)
    r.give(frame, MS)
    r.start(2 * MS)
    r.give(frame, 2 * MS)
    assert r.discarded("r") == {"replayed": 1}
    r.give(signed(b"cd", keys=keys, cycle=2), 3 * MS)
    assert r.image.read("x") == int.from_bytes(b"cd", "little")


def test_keys_change_without_a_loss():
    senders, receivers = ring(), ring()
    r = receiver(Authentication.REQUIRED, receivers)
    numbers = iter(range(1, 100))

    def exchange() -> None:
        number = next(numbers)
        r.give(signed(keys=senders, cycle=number), number * MS)

    exchange()
    receivers.keys = Keys({1: KEY, 2: OTHER_KEY}, 1)
    exchange()
    senders.keys = Keys({1: KEY, 2: OTHER_KEY}, 2)
    exchange()
    receivers.keys = Keys({2: OTHER_KEY}, 2)
    exchange()
    assert (taken(r), r.discarded()) == (4, {})
    senders.keys = Keys({1: KEY}, 1)  # the old key is no good any more
    exchange()
    assert (taken(r), r.discarded()) == (4, {"bad_tag": 1})


def test_subscriptions_of_one_frame_each_do_as_they_say():
    pds = [
        RxPdSpec("required", "eap0", 7, ("x",), PEER, version=3, auth=Authentication.REQUIRED),
        RxPdSpec("open", "eap0", 7, ("y",), PEER, version=3),
    ]
    r = Receiver(*pds, variables=received("x:UINT", "y:UINT"), keys=ring())
    forged = signed(b"ab", keys=ring(OTHER_KEY))
    for number in (1, 2):
        r.give(forged, number * MS)
    assert (r.image.read("x"), r.image.read("y")) == (0, int.from_bytes(b"ab", "little"))
    assert r.discarded("required") == {"bad_tag": 2}
    assert r.discarded("open") == {}
    r.give(signed(b"cd", keys=ring(), cycle=3), 3 * MS)
    assert r.image.read("x") == r.image.read("y") == int.from_bytes(b"cd", "little")


def test_forged_frame_keeps_no_subscription_alive():
    r = receiver(Authentication.REQUIRED)
    r.give(signed(keys=ring(), cycle=1), MS)
    arrived = r.word("r", RxWord.ARRIVED_AT_NS)
    r.give(signed(keys=ring(OTHER_KEY), cycle=2), 2 * MS)
    r.give(octets([(7, b"ab", 3)], cycle=3), 3 * MS)
    assert r.word("r", RxWord.ARRIVED_AT_NS) == arrived
    assert r.word("r", RxWord.LAST_CYCLE) == 1


@given(st.binary(max_size=SIGNED_BYTES + 40))
def test_no_frame_raises_or_passes_without_a_key(tail):
    r = receiver(Authentication.REQUIRED)
    frame = signed(keys=ring(OTHER_KEY))
    r.give(frame[: len(frame) - SIGNATURE] + tail, MS)
    r.give(frame[:FIRST_PD] + tail, 2 * MS)
    assert taken(r) == 0
