"""Listeners to a slave's Ethernet frames."""

from __future__ import annotations

from eap.ids import Endpoint
from eap.services.gateway.message_codecs import LISTENS_NS, MAX_LISTENERS, EoeListeners

A, B = Endpoint("udp:e", "10.0.0.1:1"), Endpoint("udp:e", "10.0.0.2:1")


def send(frame: bytes) -> None:
    """Nobody looks."""


def test_clients_hear_a_slave_for_a_while_after_they_talked_to_it() -> None:
    listeners = EoeListeners()
    listeners.add(1001, A, 1001, send, 0)
    listeners.add(1001, B, 0x8000 | 1001, send, 5)
    assert [each.address for each in listeners.of_slave(1001, 6)] == [1001, 0x8000 | 1001]
    assert listeners.of_slave(1002, 6) == []
    listeners.add(1001, A, 1001, send, 10)
    assert [each.address for each in listeners.of_slave(1001, LISTENS_NS + 5)] == [1001]
    listeners.forget(A)
    assert listeners.of_slave(1001, 11) == []


def test_listeners_drop_the_least_recent() -> None:
    listeners = EoeListeners()
    for number in range(MAX_LISTENERS + 1):
        listeners.add(1001, Endpoint("udp:e", str(number)), number, send, 0)
    assert [each.address for each in listeners.of_slave(1001, 1)] == [*range(1, MAX_LISTENERS + 1)]
