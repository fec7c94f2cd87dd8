from __future__ import annotations

import tracemalloc

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.ids import Destination, MacAddr, NetId
from eap.pd.address import ALTERNATION_NS, LOOK_NS, NetIdLearner, from_word, net_id_of, to_word
from eap.pd.report import station_status
from eap.pd.spec import RxPdSpec
from tests.support.cyclic import MS, OWN, PEER, From, Receiver, octets, received

macs = st.binary(min_size=6, max_size=6).map(lambda octets: str(MacAddr(octets)))
ports = st.integers(0, 65535).map(lambda port: f":{port}" if port else "")
hosts = st.builds(str.__add__, st.ip_addresses(v=4).map(str), ports)


@given(macs | hosts | hosts.map("tcp://".__add__))
def test_destination_survives_a_word(text: str) -> None:
    word = to_word(text)
    assert 0 < word < 1 << 63
    assert from_word(word) == Destination.parse(text)


@pytest.mark.parametrize("text", ["", "5.23.91.23.2.1", "whoever asks"])
def test_to_word_of_invalid_address_is_zero(text: str) -> None:
    assert to_word(text) == 0


def test_zero_is_no_address() -> None:
    assert from_word(0) is None
    assert from_word(to_word("00:00:00:00:00:00")) is not None


def test_net_id_of_returns_none_for_other_addresses() -> None:
    assert net_id_of("5.23.91.23.2.1") == NetId.parse("5.23.91.23.2.1")
    for text in ("10.0.0.1", "02:00:00:00:00:01", "tcp://10.0.0.1", "", "a.b.c.d.e.f"):
        assert net_id_of(text) is None


OWN_SOURCE = bytes((10, 77, 0, 1))
OTHER = bytes((10, 77, 0, 9))
MAC = MacAddr.parse("02:00:00:00:00:01")


def receiver(*, source: str = "10.77.0.1", publisher: str = PEER) -> Receiver:
    pds = (
        RxPdSpec("a", "eap0", 7, ("x",), publisher, step=1, source=source),
        RxPdSpec("b", "eap0", 8, ("y",), publisher, step=1, source=source),
    )
    return Receiver(*pds, variables=received("x:UINT", "y:UINT"))


def frame(value: int, cycle: int, *, pd_id: int = 7) -> bytes:
    return octets([(pd_id, value.to_bytes(2, "little"))], cycle=cycle, publisher=PEER)


def rows(r: Receiver, now_ns: int = 0) -> list[dict[str, object]]:
    return station_status(r.image, now_ns)["pd"]["rx"]


def test_subscriber_drops_frame_of_other_source_and_reports_it():
    r = receiver()
    r.give(frame(1, 1), 1 * MS, OWN_SOURCE)
    for cycle in range(2, 7):
        r.give(frame(666, cycle), cycle * MS, OTHER)
    r.give(frame(3, 2), 9 * MS, OWN_SOURCE)

    row = rows(r, 10 * MS)[0]
    assert r.image.read("x") == 3
    assert (row["received"], row["lost"], row["duplicated"]) == (2, 0, 0)
    assert row["discarded"] == {"wrong_source": 5}
    assert row["source"] == "10.77.0.1"
    assert row["wrong_source"] == {"address": "10.77.0.9", "age_us": 4000}
    assert station_status(r.image, 0)["discarded"] == {"wrong_source": 5}


def test_subscriber_drops_a_first_frame_of_another_source():
    r = receiver()
    r.give(frame(666, 1), 1 * MS, OTHER)
    assert r.image.read("x") == 0
    assert rows(r)[0]["state"] == "waiting"
    r.give(frame(5, 1), 2 * MS, OWN_SOURCE)
    assert r.image.read("x") == 5


def test_subscriber_on_ethernet_compares_mac_addresses():
    r = receiver(source=str(MAC))
    r.give(frame(1, 1), 1 * MS, MAC)
    r.give(frame(666, 2), 2 * MS, b"\x02\0\0\0\0\x02")
    row = rows(r)[0]
    assert r.image.read("x") == 1
    assert row["source"] == str(MAC)
    assert row["wrong_source"]["address"] == "02:00:00:00:00:02"


def test_subscription_of_any_source_takes_all_and_names_two_senders():
    r = receiver(source="")
    r.give(frame(1, 1), 1 * MS, OWN_SOURCE)
    r.give(frame(2, 2), 2 * MS, OTHER)
    assert rows(r)[0]["other_source"] is None  # one change: a publisher that moved
    r.give(frame(3, 3), 3 * MS, OWN_SOURCE)
    row = rows(r, 4 * MS)[0]
    assert row["source"] == "10.77.0.1"
    assert row["other_source"] == {"address": "10.77.0.9", "age_us": 1000}
    assert row["received"] == 3


def test_two_senders_that_send_different_pds_of_one_publisher_are_named():
    r = receiver(source="")
    for cycle in range(3):
        r.give(frame(1, cycle), 2 * cycle * MS, OWN_SOURCE)
        r.give(frame(2, cycle, pd_id=8), (2 * cycle + 1) * MS, OTHER)
    assert all(row["other_source"] is not None for row in rows(r))


def test_publisher_that_moves_twice_in_a_long_time_is_one_sender():
    r = receiver(source="")
    for cycle, source in enumerate((OWN_SOURCE, OTHER, OWN_SOURCE), 1):
        r.give(frame(cycle, cycle), cycle * ALTERNATION_NS, source)
    assert rows(r)[0]["other_source"] is None


def test_subscriptions_of_one_publisher_judge_the_source_each_by_its_own_rule():
    strict = RxPdSpec("a", "eap0", 7, ("x",), PEER, source="10.77.0.1")
    lax = RxPdSpec("b", "eap0", 7, ("y",), "")
    r = Receiver(strict, lax, variables=received("x:UINT", "y:UINT"))
    r.give(frame(1, 1), 1 * MS, OWN_SOURCE)
    r.give(frame(2, 2), 2 * MS, OTHER)
    assert (r.image.read("x"), r.image.read("y")) == (1, 2)


@pytest.mark.parametrize("source", ["10.77.0.1", ""])
@given(
    sent=st.lists(st.tuples(st.sampled_from((7, 8)), st.integers(0, 5)), max_size=60),
)
def test_only_frames_of_the_expected_source_count_as_received(source, sent):
    r = receiver(source=source)
    taken = {7: 0, 8: 0}
    for cycle, (pd_id, host) in enumerate(sent, 1):
        address = bytes((10, 77, 0, host))
        r.give(frame(cycle, cycle, pd_id=pd_id), cycle * MS, address)
        if not source or address == OWN_SOURCE:
            taken[pd_id] = cycle
    assert (r.image.read("x"), r.image.read("y")) == (taken[7], taken[8])
    dropped = sum(row["discarded"].get("wrong_source", 0) for row in rows(r))
    assert dropped == (sum(host != 1 for _, host in sent) if source else 0)


def test_subscriber_keeps_nothing_of_frames_without_pds():
    r = receiver()
    tracemalloc.start()
    try:
        for number in range(2000):
            r.give(octets([], publisher=f"10.66.{number >> 8}.{number & 255}.1.1"), 1 * MS, OTHER)
        kept = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert kept < 100_000


THEIR_MAC = "02:00:00:00:00:02"
OTHER_MAC = "02:00:00:00:00:03"
FRAME = octets([(1, b"\1\2")])


class Port:
    """A learner, what it learned and what it handed over."""

    def __init__(self, *wanted: str) -> None:
        self.learned: list[tuple[str, str]] = []
        self.taken: list[bytes] = []
        self.learner = NetIdLearner(lambda data, size, *_: self.taken.append(bytes(data[:size])))
        self.learner.wanted = {NetId.parse(text) for text in wanted}
        self.learner.learn = lambda net_id, mac: self.learned.append((str(NetId(net_id)), mac))

    def give(self, frame: bytes, sender: str, at_ns: int = 0) -> None:
        view = memoryview(frame + bytes(40))
        self.learner.handle(view, len(frame), at_ns, From(sender))


def test_sender_of_a_sought_net_id_is_learned_and_the_frame_handed_over():
    port = Port(PEER)
    port.give(FRAME, THEIR_MAC)
    assert port.learned == [(PEER, THEIR_MAC)]
    assert port.taken == [FRAME]


def test_learner_ignores_other_publishers():
    port = Port(OWN)
    port.give(FRAME, THEIR_MAC)
    nobody = Port()
    nobody.give(FRAME, THEIR_MAC)
    assert port.learned == nobody.learned == []
    assert port.taken == nobody.taken == [FRAME]


def test_only_process_data_has_a_publisher():
    port = Port(PEER)
    mailbox = FRAME[:1] + bytes([FRAME[1] & 0x0F | 0x50]) + FRAME[2:]
    for frame in (mailbox, FRAME[:7], FRAME[:1], b""):
        port.give(frame, THEIR_MAC)
    assert port.learned == []
    assert len(port.taken) == 4


def test_learner_ignores_frame_without_sender():
    port = Port(PEER)
    port.give(FRAME, "")
    assert port.learned == []


def test_address_is_looked_at_now_and_then():
    port = Port(PEER)
    for at_ns, mac in ((0, THEIR_MAC), (1, OTHER_MAC), (LOOK_NS, OTHER_MAC), (5, THEIR_MAC)):
        port.give(FRAME, mac, at_ns)
    # The last one came before the one that was looked at: the clock was set.
    assert [mac for _, mac in port.learned] == [THEIR_MAC, OTHER_MAC, THEIR_MAC]


def test_learner_wants_no_net_id_at_first():
    taken: list[int] = []
    learner = NetIdLearner(lambda _data, size, *_: taken.append(size))
    learner.handle(memoryview(FRAME), len(FRAME), 0, From(THEIR_MAC))
    learner.learn(bytes(6), THEIR_MAC)
    assert taken == [len(FRAME)]
