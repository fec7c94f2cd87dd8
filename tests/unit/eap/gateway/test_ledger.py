"""Clients: what they wait for, how much they may ask."""

from __future__ import annotations

from eap.aoe.way import Way
from eap.gateway.ledger import Admission, ClientLimits, Ledger, Ticket

A, B, C = (Way("udp", f"10.0.0.{number}:5") for number in (1, 2, 3))
SECOND = 1_000_000_000


def test_the_same_octets_are_one_request_until_they_are_answered() -> None:
    ledger = Ledger()
    assert ledger.admit(A, b"x", 0) is Admission.TAKEN
    assert ledger.admit(A, b"x", 1) is Admission.REPEATED
    assert ledger.admit(A, b"y", 1) is Admission.TAKEN
    assert ledger.admit(B, b"x", 1) is Admission.TAKEN
    ledger.answered(A, b"x")
    assert ledger.admit(A, b"x", 2) is Admission.TAKEN
    counts = ledger.counts_of(A)
    assert counts is not None
    assert (counts.requests, counts.repeated, counts.errors) == (3, 1, 0)
    assert ledger.counts_of(C) is None


def test_each_client_and_all_together_have_limits() -> None:
    ledger = Ledger(ClientLimits(in_flight=2, in_flight_in_all=3))
    assert [ledger.admit(A, bytes([n]), 0) for n in range(3)][-1] is Admission.CROWDED
    assert [ledger.admit(B, bytes([n]), 0) for n in range(2)][-1] is Admission.CROWDED
    ledger.forget(A)
    assert ledger.admit(B, b"\1", 0) is Admission.TAKEN
    ledger.answered(B, b"\0")
    ledger.answered(B, b"\0")
    ledger.answered(A, b"\0")
    assert ledger.admit(C, b"\0", 0) is Admission.TAKEN
    assert ledger.admit(C, b"\1", 0) is Admission.TAKEN
    assert ledger.admit(C, b"\2", 0) is Admission.CROWDED


def test_requests_in_a_second() -> None:
    ledger = Ledger(ClientLimits(rate=2))

    def ask(at_s: float) -> bool:
        ledger.answered(A, b"x")
        admission = ledger.admit(A, b"x", int(at_s * SECOND))
        assert admission in {Admission.TAKEN, Admission.TOO_FAST}
        return admission is Admission.TAKEN

    assert [ask(0), ask(0), ask(0)] == [True, True, False]
    assert [ask(0.4), ask(0.5), ask(0.6)] == [False, True, False]
    assert [ask(100), ask(100), ask(100)] == [True, True, False]


def test_who_was_silent_longest_makes_room() -> None:
    ledger = Ledger(ClientLimits(clients=2))
    ledger.admit(A, b"x", 0)
    ledger.admit(B, b"x", 1)
    assert ledger.admit(C, b"x", 2) is Admission.CROWDED, "both wait for something"
    ledger.answered(B, b"x")
    assert ledger.admit(C, b"x", 3) is Admission.TAKEN
    assert list(ledger.table()) == [A, C]
    ledger.admit(A, b"y", 4)
    assert list(ledger.table()) == [C, A]


def test_a_ticket_is_given_back_once() -> None:
    ledger = Ledger()
    ledger.admit(A, b"a", 0)
    ticket = Ticket(ledger, A, b"a")
    ticket.give_back()
    assert ledger.admit(A, b"a", 1) is Admission.TAKEN
    ticket.give_back()
    assert ledger.waiting(A) == 1
