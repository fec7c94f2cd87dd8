from __future__ import annotations

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.pd.address import to_word
from eap.pd.image import Image
from eap.pd.layout import TxSlot
from eap.pd.link import OutFrame
from eap.pd.monitor import SubscriberPresence
from eap.pd.publisher import enter_refused, enter_sent, enter_skipped, enter_suppressed
from eap.pd.report import (
    frame_state,
    frame_status,
    group_list,
    pd_list,
    quality,
    station_status,
    tx_var_state,
    unsent_state,
)
from eap.pd.spec import RxPdSpec, TxFrameSpec, TxPdSpec
from eap.pd.words import REASON_INDEX, FrameState, FrameWord, Reason, RxWord, StationWord, TxWord
from tests.support.cyclic import (
    MS,
    OWN,
    PEER,
    Receiver,
    image_of,
    octets,
    received,
    station,
    written,
)


def receiver(**options: object) -> Receiver:
    cycle_us = options.pop("cycle_us", 1000)
    options = {"step": 1, "sender_cycle_us": 1000} | options
    return Receiver(
        RxPdSpec("r", "eap0", 7, ("x",), PEER, **options),
        variables=received("x:UINT"),
        cycle_us=cycle_us,
    )


class NaiveQuality:
    """Each receiver cycle it grows by the cycle time, before the input image is refreshed."""

    def __init__(self, cycle_us: int) -> None:
        self.cycle_us = cycle_us
        self.value = 0
        self.remainder_us = 0

    def cycle(self) -> None:
        self.remainder_us += self.cycle_us
        self.value = min(self.value + self.remainder_us // 100, 0xFFFF)
        self.remainder_us %= 100

    def arrive(self, sent: int) -> None:
        self.value = sent
        self.remainder_us = 0


@pytest.mark.parametrize("cycle_us", [100, 250, 333, 1000, 10_000])
@given(
    steps=st.lists(
        st.one_of(st.none(), st.integers(0, 0xFFFF), st.just(0)), min_size=1, max_size=60
    ),
    idle=st.integers(0, 100),
)
def test_quality_equals_counting_in_every_cycle(cycle_us, steps, idle):
    r = receiver(cycle_us=cycle_us)
    naive = NaiveQuality(cycle_us)
    arrived = False
    words = r.image.words
    for counter, sent in enumerate([0, *steps, *[None] * idle]):
        words[StationWord.ENGINE_SEQUENCE] += 1
        words[StationWord.CYCLE] += 1
        naive.cycle()
        if sent is not None:
            r.give(octets([(7, b"ab", 0, sent)], cycle=counter), counter * cycle_us * 1000)
            naive.arrive(sent)
            arrived = True
        words[StationWord.ENGINE_SEQUENCE] += 1
        assert arrived
        assert quality(r.image, r.slot("r")) == naive.value


def test_quality_saturates():
    r = receiver()
    r.give(octets([(7, b"ab", 0, 65_000)]), 0)
    r.image.words[StationWord.CYCLE] += 53
    assert quality(r.image, r.slot("r")) == 65_000 + 520
    r.image.words[StationWord.CYCLE] += 2
    assert quality(r.image, r.slot("r")) == 65_535
    r.image.words[StationWord.CYCLE] += 10**9
    assert quality(r.image, r.slot("r")) == 65_535


def test_quality_of_frame_between_cycles_is_fresh():
    r = receiver()
    r.image.words[StationWord.CYCLE] = 5
    r.give(octets([(7, b"ab", 0, 30)]), 0)
    assert quality(r.image, r.slot("r")) == 30
    r.image.words[StationWord.CYCLE] = 6
    assert quality(r.image, r.slot("r")) == 30
    r.image.words[StationWord.CYCLE] = 7
    assert quality(r.image, r.slot("r")) == 40


def test_report_of_waiting_subscription_has_nulls():
    row = station_status(receiver().image, 99 * MS)["pd"]["rx"][0]
    assert row == {
        "name": "r",
        "port": "eap0",
        "received": 0,
        "lost": 0,
        "duplicated": 0,
        "reordered": 0,
        "late": 0,
        "timeouts": 0,
        "repeated": 0,
        "discarded": {},
        "quality": None,
        "cycle_index": None,
        "var_state": 0,
        "age_us": None,
        "last_good": None,
        "jitter_us": {"p50": None, "p99": None, "max": None},
        "response_us": None,
        "source": None,
        "other_source": None,
        "wrong_source": None,
        "state": "waiting",
    }


def test_report_of_running_subscription_is_complete():
    r = receiver()
    for cycle, at_us in ((65_534, 0), (65_535, 1004), (2, 4000)):
        r.give(octets([(7, b"ab")], cycle=cycle), at_us * 1000)
    r.give(octets([(7, b"abc")]), 5 * MS)
    row = station_status(r.image, 9 * MS)["pd"]["rx"][0]
    assert (row["received"], row["lost"], row["cycle_index"]) == (3, 2, 2)
    assert (row["age_us"], row["state"], row["var_state"]) == (5000, "running", 2)
    assert row["jitter_us"] == {"p50": 4, "p99": 4, "max": 4}
    assert row["discarded"] == {"length": 1}


def test_lost_is_null_where_the_step_is_unknown():
    r = receiver(step=0)
    r.give(octets([(7, b"ab")], cycle=1), 0)
    r.give(octets([(7, b"ab")], cycle=900), MS)
    assert station_status(r.image, 0)["pd"]["rx"][0]["lost"] is None


def test_a_station_before_its_start_is_in_init():
    image = receiver().image
    status = station_status(image, 0)
    assert (status["state"], status["cycle"], status["discarded"]) == ("INIT", 0, {})
    assert status["lateness_us"] == {"p50": None, "p99": None, "max": None}
    image.words[StationWord.STATE] = 8
    assert station_status(image, 0)["state"] == "OP"


def test_groups_have_their_stations_by_cycle_and_phase():
    def ran(name: str, at_ns: int, behind_ns: int = 0, cycle_us: int = 1000) -> Image:
        image = image_of(station(name, cycle_us=cycle_us))
        image.words[StationWord.CYCLE_AT_NS] = at_ns
        image.words[StationWord.BEHIND_NS] = behind_ns
        return image

    images = [
        ran("slow", 7 * MS, 90_000, cycle_us=2000),
        ran("a", 3 * MS),
        ran("new", 0),
        ran("half", 3 * MS + 500_000),
        ran("b", 7 * MS, 41_999),
    ]
    assert group_list(images) == [
        {"cycle_us": 1000, "phase_us": 0, "stations": ["a", "b"], "last_us": 41},
        {"cycle_us": 1000, "phase_us": 500, "stations": ["half"], "last_us": 0},
        {"cycle_us": 2000, "phase_us": 1000, "stations": ["slow"], "last_us": 90},
    ]


def test_members_of_one_tracker_report_the_same_counters_and_their_own_discards():
    r = Receiver(
        RxPdSpec("r", "eap0", 1, ("x",), PEER, step=1),
        RxPdSpec("s", "eap0", 2, ("y",), PEER, step=1),
        variables=received("x:UINT", "y:UINT"),
    )
    r.give(octets([(1, b"ab"), (2, b"cd")], cycle=3), MS)
    assert r.image.words[r.slot("s").words + RxWord.TRACKER] == r.slot("r").words
    r.give(octets([(2, b"toolong")], cycle=4), MS)
    rows = station_status(r.image, MS)["pd"]["rx"]
    assert [row["received"] for row in rows] == [1, 1]
    assert [row["discarded"] for row in rows] == [{}, {"length": 1}]


def test_the_list_names_every_pd_with_its_variables():
    spec = station(
        variables=(*written("x:UINT"), *received("y:REAL")),
        frames=(TxFrameSpec("f", "eap0", "10.0.0.9", (TxPdSpec("p", 1, ("x",), version=4),)),),
        subscriptions=(RxPdSpec("r", "eap0", 2, ("y",)),),
    )
    sent, taken = pd_list(image_of(spec))
    assert msgspec.to_builtins(sent) == {
        "station": "a",
        "direction": "tx",
        "name": "p",
        "id": 1,
        "version": 4,
        "length": 2,
        "port": "eap0",
        "poll": None,
        "publisher": OWN,
        "frame": "f",
        "destination": "10.0.0.9",
        "variables": [{"name": "x", "type": "UINT", "unit": "", "writer": "application"}],
    }
    assert (taken.direction, taken.publisher, taken.length) == ("rx", None, 4)
    assert msgspec.json.encode([sent, taken])


def test_values_that_links_held_back_are_counted():
    image = image_of(station())
    image.words[StationWord.LINKS_HELD] = 3
    assert station_status(image, 0)["links_held"] == 3


def test_frame_state_combines_publisher_and_monitor():
    spec = station(
        variables=written("x:UINT"),
        frames=(TxFrameSpec("f", "eap0", "10.0.0.9", (TxPdSpec("p", 1, ("x",)),)),),
    )
    image = image_of(spec)
    first = image.layout.frames[0].words
    seen = []
    for state, presence in (
        (0, SubscriberPresence.UNKNOWN),
        (3, SubscriberPresence.MISSING),
        (1, SubscriberPresence.PRESENT),
    ):
        image.words[first + FrameWord.UNSENT] = state
        image.words[first + FrameWord.PRESENCE] = presence
        (row,) = station_status(image, 0)["pd"]["tx"]
        seen.append((row["frame_state"], row["subscriber"]))
    assert seen == [(0, "unknown"), (7, "missing"), (1, "present")]
    assert msgspec.json.encode(station_status(image, 0))


@pytest.fixture
def image() -> Image:
    pds = (TxPdSpec("p", 1, ("x",)),)
    frames = (
        TxFrameSpec("f", "eap0", "10.0.0.9", pds, monitor_interval_ms=1000),
        TxFrameSpec("g", "eap0", "239.0.0.9", (TxPdSpec("q", 2, ("x",)),)),
    )
    return image_of(station(variables=written("x:UINT"), frames=frames))


def put(image: Image, **words: int) -> None:
    first = image.layout.frames[0].words
    for name, value in words.items():
        image.words[first + FrameWord[name]] = value


@pytest.mark.parametrize(
    ("state", "presence", "expected"),
    [
        (0, SubscriberPresence.UNKNOWN, 0),
        (0, SubscriberPresence.PRESENT, 0),
        (0, SubscriberPresence.MISSING, 4),
        (1, SubscriberPresence.MISSING, 5),
        (1, SubscriberPresence.UNKNOWN, 1),
    ],
)
def test_bit_2_of_the_state_is_subscriber_missing(
    image: Image, state: int, presence: SubscriberPresence, expected: int
) -> None:
    put(image, UNSENT=state, PRESENCE=presence)
    assert frame_state(image, image.layout.frames[0].words) == expected


def test_status_of_a_frame(image: Image) -> None:
    put(image, WHOLE=5, PARTIAL=2, SKIPPED=1, PRESENCE=1, ADDRESS=to_word("10.0.0.8:4000"))
    assert frame_status(image, image.layout.frames[0]) == {
        "name": "f",
        "port": "eap0",
        "destination": "10.0.0.9",
        "address": "10.0.0.8:4000",
        "sent": 7,
        "skipped": 1,
        "frame_state": 0,
        "monitor_interval_ms": 1000,
        "subscriber": "present",
    }


def test_frame_status_without_monitoring_is_unknown(image: Image) -> None:
    row = frame_status(image, image.layout.frames[1])
    assert (row["monitor_interval_ms"], row["subscriber"]) == (None, "unknown")
    assert row["address"] is None


CHANGE = REASON_INDEX[Reason.CHANGE]


def outcome_image() -> tuple[Image, TxSlot, TxSlot]:
    """A frame of a PD that is pushed and one that is polled."""
    made = image_of(
        station(
            variables=(*written("x:UINT"), *received("r:UINT")),
            subscriptions=(RxPdSpec("asked", "eap0", 9, ("r",)),),
            frames=(
                TxFrameSpec(
                    "f",
                    "eap0",
                    "10.0.0.1",
                    (TxPdSpec("p", 1, ("x",)), TxPdSpec("q", 2, ("x",), poll_request="asked")),
                ),
            ),
        )
    )
    return made, *made.layout.tx


def test_enter_sent_counts_pd_under_its_reason():
    made, p, _ = outcome_image()
    enter_sent(made.words, p, CHANGE, 700)
    enter_sent(made.words, p, CHANGE, 800)
    words = made.words[p.words : p.words + TxWord.SIZE]
    assert words[TxWord.REASON + CHANGE] == 2
    assert (words[TxWord.LAST_REASON], words[TxWord.SENT_AT_NS]) == (CHANGE, 800)
    assert tx_var_state(made.words, p) == 0


def test_tx_var_state_is_set_from_skip_until_sent():
    made, p, q = outcome_image()
    assert tx_var_state(made.words, p) == 0
    enter_skipped(made.words, [p, q], 500)
    assert (tx_var_state(made.words, p), tx_var_state(made.words, q)) == (1, 1)
    enter_sent(made.words, p, CHANGE, 600)
    assert (tx_var_state(made.words, p), tx_var_state(made.words, q)) == (0, 1)
    assert made.words[q.words + TxWord.SKIPPED] == 1


def test_a_frame_that_goes_whole_sends_its_pds_but_none_that_is_polled():
    made, p, q = outcome_image()
    enter_skipped(made.words, [p, q], 500)
    made.words[p.frame_words + FrameWord.SENT_AT_NS] = 500  # with others, in the same cycle
    assert (tx_var_state(made.words, p), tx_var_state(made.words, q)) == (1, 1)
    made.words[p.frame_words + FrameWord.WHOLE] += 1
    made.words[p.frame_words + FrameWord.SENT_AT_NS] = 600
    assert (tx_var_state(made.words, p), tx_var_state(made.words, q)) == (0, 1)


def test_unsent_state_has_reason_until_sent():
    made, p, _ = outcome_image()
    (frame,) = made.layout.frames
    out = OutFrame(bytearray(20), 0, "10.0.0.1")
    assert unsent_state(made.words, p.frame_words) == 0
    enter_suppressed(made.words, frame, 500)
    assert unsent_state(made.words, p.frame_words) == FrameState.NOT_SENT
    out.oversized = True
    enter_refused(made.words, frame, out, 600)
    assert unsent_state(made.words, p.frame_words) == FrameState.NOT_SENT | FrameState.OVERSIZED
    out.oversized = False
    enter_refused(made.words, frame, out, 700)
    assert unsent_state(made.words, p.frame_words) == FrameState.NOT_SENT
    made.words[p.frame_words + FrameWord.SENT_AT_NS] = 800
    assert unsent_state(made.words, p.frame_words) == 0
    assert made.words[p.frame_words + FrameWord.SKIPPED] == 3
