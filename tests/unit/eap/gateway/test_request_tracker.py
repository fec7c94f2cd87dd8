"""Clients: what they wait for, how much they may ask."""

from __future__ import annotations

from eap.gateway.request_tracker import ClientLimits, RequestAdmission, RequestTracker, Ticket
from eap.ids import Endpoint

A, B, C = (Endpoint("udp", f"10.0.0.{number}:5") for number in (1, 2, 3))
SECOND = 1_000_000_000


def test_the_same_octets_are_one_request_until_they_are_answered() -> None:
    tracker = RequestTracker()
    assert tracker.admit(A, b"x", 0) is RequestAdmission.TAKEN
    assert tracker.admit(A, b"x", 1) is RequestAdmission.REPEATED
    assert tracker.admit(A, b"y", 1) is RequestAdmission.TAKEN
    assert tracker.admit(B, b"x", 1) is RequestAdmission.TAKEN
    tracker.answered(A, b"x")
    assert tracker.admit(A, b"x", 2) is RequestAdmission.TAKEN
    counts = tracker.counts_of(A)
    assert counts is not None
    assert (counts.requests, counts.repeated, counts.errors) == (3, 1, 0)
    assert tracker.counts_of(C) is None


def test_each_client_and_all_together_have_limits() -> None:
    tracker = RequestTracker(ClientLimits(in_flight=2, in_flight_in_all=3))
    assert [tracker.admit(A, bytes([n]), 0) for n in range(3)][-1] is RequestAdmission.CROWDED
    assert [tracker.admit(B, bytes([n]), 0) for n in range(2)][-1] is RequestAdmission.CROWDED
    tracker.forget(A)
    assert tracker.admit(B, b"\1", 0) is RequestAdmission.TAKEN
    tracker.answered(B, b"\0")
    tracker.answered(B, b"\0")
    tracker.answered(A, b"\0")
    assert tracker.admit(C, b"\0", 0) is RequestAdmission.TAKEN
    assert tracker.admit(C, b"\1", 0) is RequestAdmission.TAKEN
    assert tracker.admit(C, b"\2", 0) is RequestAdmission.CROWDED


def test_requests_in_a_second() -> None:
    tracker = RequestTracker(ClientLimits(rate=2))

    def ask(at_s: float) -> bool:
        tracker.answered(A, b"x")
        admission = tracker.admit(A, b"x", int(at_s * SECOND))
        assert admission in {RequestAdmission.TAKEN, RequestAdmission.TOO_FAST}
        return admission is RequestAdmission.TAKEN

    assert [ask(0), ask(0), ask(0)] == [True, True, False]
    assert [ask(0.4), ask(0.5), ask(0.6)] == [False, True, False]
    assert [ask(100), ask(100), ask(100)] == [True, True, False]


def test_tracker_forgets_the_client_silent_longest() -> None:
    tracker = RequestTracker(ClientLimits(clients=2))
    tracker.admit(A, b"x", 0)
    tracker.admit(B, b"x", 1)
    assert tracker.admit(C, b"x", 2) is RequestAdmission.CROWDED, "both wait for something"
    tracker.answered(B, b"x")
    assert tracker.admit(C, b"x", 3) is RequestAdmission.TAKEN
    assert list(tracker.table()) == [A, C]
    tracker.admit(A, b"y", 4)
    assert list(tracker.table()) == [C, A]


def test_a_ticket_is_given_back_once() -> None:
    tracker = RequestTracker()
    tracker.admit(A, b"a", 0)
    ticket = Ticket(tracker, A, b"a")
    ticket.release()
    assert tracker.admit(A, b"a", 1) is RequestAdmission.TAKEN
    ticket.release()
    assert tracker.waiting(A) == 1
