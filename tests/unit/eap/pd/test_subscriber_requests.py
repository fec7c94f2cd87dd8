"""PDs that ask for others: noted with their senders."""

from __future__ import annotations

from eap.pd.poll import REQUESTERS_PER_CYCLE, Requests
from eap.pd.spec import RxPdSpec
from eap.pd.subscriber import Subscriber
from eap.pd.words import RxWord
from tests.support.cyclic import MS, PEER, Receiver, give, octets, received


def asking(*names: str) -> tuple[Receiver, Requests]:
    """A receiver of r and s, of which those called *names* are requests."""
    r = Receiver(
        RxPdSpec("r", "eap0", 1, ("x",), PEER),
        RxPdSpec("s", "eap0", 2, ("y",)),
        variables=received("x:UINT", "y:UINT"),
    )
    requests = Requests(names)
    pairs = zip(r.spec.subscriptions, r.image.layout.rx, strict=True)
    r.subscriber = Subscriber(r.image, list(pairs), MS, requests)
    r.subscriber.open(0)
    return r, requests


def test_a_request_is_noted_with_its_sender_and_taken_like_any_other_pd():
    r, requests = asking("r")
    for cycle in (1, 2):
        frame = octets([(1, b"ab"), (2, b"cd")], cycle=cycle)
        give(r.subscriber.receive_frame, frame, cycle * MS, "10.0.0.1:7")
        assert requests.take() == {"10.0.0.1:7": {"r"}}
    give(r.subscriber.receive_frame, octets([(2, b"cd")], cycle=3), 3 * MS, "10.0.0.1:7")
    assert requests.take() == {}
    assert (r.word("r", RxWord.RECEIVED), r.word("s", RxWord.RECEIVED)) == (2, 3)
    assert r.discarded() == {}


def test_a_request_that_is_not_taken_is_not_answered():
    r, requests = asking("r")
    r.give(octets([(1, b"ab")], cycle=9), MS)
    requests.take()
    r.give(octets([(1, b"ab")], cycle=8), 2 * MS)  # reordered
    r.give(octets([(1, b"abc")], cycle=10), 3 * MS)
    r.subscriber.close()
    r.give(octets([(1, b"ab")], cycle=11), 4 * MS)
    assert requests.take() == {}


def test_a_request_from_nowhere_is_counted_and_its_data_taken():
    r, requests = asking("r", "s")
    give(r.subscriber.receive_frame, octets([(1, b"ab"), (2, b"cd")], cycle=1), MS, "")
    assert requests.take() == {}
    assert r.discarded() == {"no_sender": 2}
    assert r.discarded("r") == r.discarded("s") == {"no_sender": 1}
    assert r.image.read("x") == 0x6261


def test_requests_of_too_many_are_counted():
    r, requests = asking("s")
    for number in range(REQUESTERS_PER_CYCLE + 3):
        publisher = f"10.0.0.{number}.1.1"
        frame = octets([(2, b"cd")], cycle=7, publisher=publisher)
        give(r.subscriber.receive_frame, frame, MS, publisher)
    assert len(requests.take()) == REQUESTERS_PER_CYCLE
    assert r.discarded() == r.discarded("s") == {"too_many_requests": 3}
    assert r.word("s", RxWord.RECEIVED) == REQUESTERS_PER_CYCLE + 3
