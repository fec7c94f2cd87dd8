"""Requests and answers: who asked, what is waited for, and whole exchanges over a line."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.ids import InterfaceUri
from eap.net.loopback import LoopbackLines
from eap.pd.engine import Engine
from eap.pd.image import Image
from eap.pd.poll import (
    REQUESTERS_PER_CYCLE,
    OutgoingPoll,
    PollRequests,
    outgoing_polls,
    requests_at,
)
from eap.pd.report import station_status
from eap.pd.spec import (
    REQUESTER,
    CounterSource,
    RxPdSpec,
    StationSpec,
    Substitute,
    TriggerSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Writer,
)
from eap.pd.station import Station
from eap.pd.words import FrameWord, TxWord
from tests.support.cyclic import MS, eap_port, image_of, received, station, written
from tests.support.examples import examples

CLIENT, MILL, LATHE = "5.0.0.1.1.1", "5.0.0.2.1.1", "5.0.0.3.1.1"


def test_requests_are_taken_once_and_by_sender():
    requests = PollRequests(["a", "b"])
    assert requests.pop_all() == {}
    assert requests.add("left", ["a"])
    assert requests.add("right", ["b"])
    assert requests.add("left", ["b", "a"])
    assert requests.pop_all() == {"left": {"a", "b"}, "right": {"b"}}
    assert requests.pop_all() == {}


def test_poll_requests_drop_requesters_beyond_limit():
    requests = PollRequests(["a"])
    taken = [requests.add(f"10.0.0.{n}", ["a"]) for n in range(REQUESTERS_PER_CYCLE + 1)]
    assert taken == [True] * REQUESTERS_PER_CYCLE + [False]
    assert requests.add("10.0.0.0", ["a"])  # it has a place already
    assert len(requests.pop_all()) == REQUESTERS_PER_CYCLE
    assert requests.add("10.0.0.99", ["a"])


class Asked:
    """The question of a station that asks for the answers a and b, and what its publisher does."""

    def __init__(self, trigger: TriggerSpec) -> None:
        spec = desk(trigger, answers=("a", "b"))
        self.image = image_of(spec)
        (self.slot,) = self.image.layout.tx
        self.poll: OutgoingPoll = outgoing_polls(self.image)["request"]

    def send(self, now_ns: int) -> None:
        if self.slot.by_schedule:
            self.image.words[self.slot.frame_words + FrameWord.WHOLE] += 1
        else:
            self.image.words[self.slot.words + TxWord.SENT_AT_NS] = now_ns
        self.poll.look(now_ns)


def desk(trigger: TriggerSpec = TriggerSpec(), answers: tuple[str, ...] = ()) -> StationSpec:  # noqa: B008
    return station(
        "desk",
        ports=(eap_port("eap0", CLIENT),),
        variables=(*written("x:UINT"), *received(*(f"{name}.n:UDINT" for name in answers))),
        frames=(
            TxFrameSpec("ask", "eap0", "10.0.0.9", (TxPdSpec("request", 70, ("x",), 0, trigger),)),
        ),
        subscriptions=tuple(
            RxPdSpec(name, "eap0", 71 + at, (f"{name}.n",), MILL, poll_request="request")
            for at, name in enumerate(answers)
        ),
    )


@pytest.mark.parametrize("trigger", [TriggerSpec(), TriggerSpec(event=True)])
def test_an_answer_took_as_long_as_since_the_last_request(trigger):
    asked = Asked(trigger)
    assert asked.poll.enter_answer("a", 5 * MS) is None  # nobody asked
    asked.send(10 * MS)
    asked.poll.look(11 * MS)  # cycles in which nothing was sent
    asked.poll.look(12 * MS)
    assert asked.poll.enter_answer("a", 13 * MS) == 3 * MS
    assert asked.poll.enter_answer("b", 14 * MS) == 4 * MS
    asked.send(20 * MS)
    # It came before the request did, and was taken behind it.
    assert asked.poll.enter_answer("a", 19 * MS) == 9 * MS
    assert asked.poll.enter_answer("a", 21 * MS) == 1 * MS
    assert asked.poll.enter_answer("a", 9 * MS) is None


def test_waiting_begins_with_the_first_request_that_has_no_answer():
    asked = Asked(TriggerSpec(event=True))
    poll = asked.poll
    assert poll.requested_since("a") is None
    asked.send(10 * MS)
    asked.send(20 * MS)
    assert poll.requested_since("a") == poll.requested_since("b") == 10 * MS
    poll.enter_answer("a", 19 * MS)
    assert (poll.requested_since("a"), poll.requested_since("b")) == (20 * MS, 10 * MS)
    poll.enter_answer("a", 25 * MS)
    poll.enter_answer("b", 26 * MS)
    assert poll.requested_since("a") is poll.requested_since("b") is None


def test_poll_duplicate_answer_does_not_affect_waiting():
    asked = Asked(TriggerSpec(event=True))
    asked.send(10 * MS)
    asked.send(20 * MS)
    assert asked.poll.enter_answer("a", 21 * MS) == 1 * MS
    assert asked.poll.enter_answer("a", 19 * MS) == 9 * MS  # late, and of another way
    assert asked.poll.requested_since("a") is None


def test_poll_continues_after_handover():
    before, after = Asked(TriggerSpec(event=True)), Asked(TriggerSpec(event=True))
    before.send(10 * MS)
    before.poll.enter_answer("b", 11 * MS)
    words, first = after.image.words, after.slot.words
    words[first + TxWord.SENT_AT_NS] = 10 * MS  # carried over with all other words
    after.poll.follow(before.poll)
    after.poll.look(12 * MS)  # nothing was sent in that cycle
    assert after.poll.requested_since("a") == 10 * MS
    assert after.poll.requested_since("b") is None
    assert after.poll.enter_answer("a", 13 * MS) == 3 * MS


def test_pending_requests_are_answered_after_handover():
    before, after = PollRequests(["old", "both"]), PollRequests(["both", "new"])
    before.add("left", ["old", "both"])
    before.add("right", ["old"])
    after.follow(before)
    assert after.pop_all() == {"left": {"both"}}


def test_polls_and_requests_are_found_by_port():
    spec = server("mill", MILL, 71, pds=2)
    assert requests_at(spec, "eap0").names == {"asked"}
    assert requests_at(spec, "eap1").names == frozenset()
    assert outgoing_polls(image_of(spec)) == {}


def server(name: str, net_id: str, pd_id: int, *, pds: int = 1, phase_us: int = 0) -> StationSpec:
    """A station that answers with its cycle counter, *pds* times."""
    return station(
        name,
        phase_us=phase_us,
        ports=(eap_port("eap0", net_id),),
        variables=(*received("asked.x:UINT"), VariableSpec("n", "UDINT", Writer.ENGINE)),
        sources=(CounterSource("n"),),
        subscriptions=(RxPdSpec("asked", "eap0", 70, ("asked.x",), CLIENT),),
        frames=(
            TxFrameSpec(
                "answer",
                "eap0",
                REQUESTER,
                tuple(
                    TxPdSpec(f"part{at}", pd_id + at, ("n",), poll_request="asked")
                    for at in range(pds)
                ),
            ),
        ),
    )


class Exchange:
    """A client of 10 ms at phase 0 and two servers of 1 ms on one line."""

    def __init__(self, options: str = "", *, phases: tuple[int, int] = (300, 700), **rx: Any):
        self.client = station(
            "desk",
            cycle_us=10_000,
            ports=(eap_port("eap0", CLIENT),),
            variables=(*written("x:UINT"), *received("a:UDINT", "b:UDINT", "c:UDINT")),
            frames=(TxFrameSpec("ask", "eap0", "239.1.1.1", (TxPdSpec("request", 70, ("x",)),)),),
            subscriptions=tuple(
                RxPdSpec(
                    name,
                    "eap0",
                    pd_id,
                    (name,),
                    net_id,
                    poll_request="request",
                    sender_cycle_us=1000,
                    **rx,
                )
                for name, pd_id, net_id in (("a", 71, MILL), ("b", 72, MILL), ("c", 81, LATHE))
            ),
        )
        servers = (
            server("mill", MILL, 71, pds=2, phase_us=phases[0]),
            server("lathe", LATHE, 81, phase_us=phases[1]),
        )
        lines = LoopbackLines()
        self.images: dict[str, Image] = {}
        self.frames = {"desk": 0, "mill": 0, "lathe": 0}
        stations = []
        for spec in (self.client, *servers):
            channel = lines.open(InterfaceUri.parse(f"loop://line{options}"))
            made = Station(spec, image_of(spec), lambda: None)
            channel.handlers += [made.handlers["eap0"], self._counter(spec.name)]
            made.connect("eap0", channel)
            self.images[spec.name] = made.image
            stations.append(made)
        self.engine = Engine(stations)
        self.engine.start(0)

    def _counter(self, name):
        def count(data, size, at_ns, origin):
            self.frames[name] += 1

        return count

    def run_until(self, limit_ns: int) -> None:
        while self.engine.next_timeout() <= limit_ns:
            self.engine.handle_timeout(self.engine.next_timeout())

    def row(self, station: str, direction: str, name: str, now_ns: int = 0) -> dict[str, Any]:
        rows = station_status(self.images[station], now_ns)["pd"][direction]
        return next(row for row in rows if row["name"] == name)


def test_several_servers_answer_one_request_each_in_its_own_cycle():
    exchange = Exchange()
    exchange.run_until(1000 * MS)
    assert exchange.row("desk", "tx", "request")["sent"] == 100
    for server, part in (("mill", "part0"), ("mill", "part1"), ("lathe", "part0")):
        row = exchange.row(server, "tx", part)
        assert (row["reason"], row["last_reason"], row["skipped"]) == ({"poll": 99}, "poll", 0)
    for name, response_us in (("a", 300), ("b", 300), ("c", 700)):
        row = exchange.row("desk", "rx", name)
        assert (row["received"], row["lost"], row["late"], row["state"]) == (99, None, 0, "running")
        assert row["quality"] == response_us // 100
        assert row["response_us"]["last"] == row["response_us"]["max"] == response_us
        assert row["jitter_us"]["max"] is None
    # Both PDs of the mill in one frame, and nobody hears answers but who asked.
    assert exchange.frames == {"desk": 2 * 99, "mill": 99, "lathe": 99}
    assert exchange.row("mill", "rx", "asked")["response_us"] is None
    # Each answer holds what the server had in the cycle that it answered in.
    assert exchange.images["desk"].read("a") == exchange.images["desk"].read("b")
    assert exchange.images["desk"].read("a") % 10 == exchange.images["desk"].read("c") % 10


def test_quality_grows_with_the_cycles_of_the_client_until_the_next_answer():
    exchange = Exchange("?delay_us=12000")
    exchange.run_until(50 * MS)
    # Asked at 10, taken at 22.3, back at 34.3 when the request of 30 was the last: 4.3 ms.
    assert exchange.row("desk", "rx", "a")["quality"] == 43
    assert exchange.row("desk", "rx", "a")["late"] == 0


def test_poll_without_answer_times_out_and_recovers():
    exchange = Exchange(timeout_ms=15, substitute=Substitute.ZERO)
    exchange.run_until(100 * MS)
    assert exchange.row("desk", "rx", "a")["timeouts"] == 0
    lathe, mill = exchange.images["lathe"], exchange.images["mill"]
    for image, name in ((lathe, "answer.FrameCtrl"), (mill, "part1.VarCtrl")):
        with image.writing(Writer.APPLICATION):
            image.write(name, 1)
    exchange.run_until(200 * MS)
    states = [exchange.row("desk", "rx", name)["state"] for name in ("a", "b", "c")]
    assert states == ["running", "stale", "stale"]
    assert exchange.images["desk"].read("b") == 0
    row = exchange.row("lathe", "tx", "part0")
    assert (row["skipped"], row["var_state"], row["frame_state"]) == (10, 1, 1)
    row = exchange.row("mill", "tx", "part1")
    assert (row["skipped"], row["var_state"], row["frame_state"]) == (10, 1, 0)
    assert exchange.row("mill", "tx", "part0")["skipped"] == 0
    for image, name in ((lathe, "answer.FrameCtrl"), (mill, "part1.VarCtrl")):
        with image.writing(Writer.APPLICATION):
            image.write(name, 0)
    exchange.run_until(300 * MS)
    states = [exchange.row("desk", "rx", name)["state"] for name in ("a", "b", "c")]
    assert states == ["running"] * 3
    assert exchange.row("lathe", "tx", "part0")["var_state"] == 0
    assert exchange.row("mill", "tx", "part1")["var_state"] == 0


def test_polled_pd_does_not_time_out_without_new_request():
    exchange = Exchange(timeout_ms=15)
    exchange.run_until(95 * MS)
    with exchange.images["desk"].writing(Writer.APPLICATION):
        exchange.images["desk"].write("request.VarCtrl", 1)  # suppresses it
    exchange.run_until(500 * MS)
    row = exchange.row("desk", "rx", "a")
    assert (row["state"], row["timeouts"]) == ("running", 0)
    assert row["quality"] >= 4000


@examples(25)
@given(
    loss=st.sampled_from([0.0, 0.2]),
    duplicate=st.sampled_from([0.0, 0.3]),
    delay_us=st.integers(0, 25_000),
    phases=st.tuples(st.integers(0, 999), st.integers(0, 999)),
    seed=st.integers(0, 1000),
)
def test_whatever_the_line_does_no_answer_comes_unasked(loss, duplicate, delay_us, phases, seed):
    options = f"?loss={loss}&duplicate={duplicate}&delay_us={delay_us}&seed={seed}"
    exchange = Exchange(options, phases=phases)
    exchange.run_until(400 * MS)
    asked = exchange.row("desk", "tx", "request")["sent"]
    assert asked == 40
    for server, part, name in (("mill", "part0", "a"), ("lathe", "part0", "c")):
        heard = exchange.row(server, "rx", "asked")
        sent = exchange.row(server, "tx", part)
        # Doubles come together: one answer.  What came in the cycle that runs is still to do.
        assert sent["sent"] == heard["received"] - heard["duplicated"]
        assert sent["skipped"] == 0
        row = exchange.row("desk", "rx", name)
        assert row["received"] - row["duplicated"] <= sent["sent"] <= asked
        if not loss:
            on_the_way = 1 + 2 * (delay_us // 10_000 + 1)
            assert row["received"] >= asked - on_the_way
            assert row["quality"] <= 100
        # Counted from the last request, so less than the client's cycle.
        assert (row["response_us"]["max"] or 0) <= 10_000
