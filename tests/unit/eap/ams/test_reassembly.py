from __future__ import annotations

import pytest

from eap.ads.endpoint import Endpoint
from eap.ams import reassembly
from eap.ams.reassembly import FRAGMENT_TIMEOUT_NS, MAX_SENDERS, Reassembly, iter_fragments
from eap.codec.ams import decode_packet
from eap.errors import MalformedError
from tests.support.ams import Ams

PACKET = Ams("5.1.1.1.1.1:851", "6.1.1.1.1.1:3000", body=bytes(100)).octets()
PIECES = [decode_packet(each) for each in iter_fragments(PACKET, 3, 60)]


def endpoint(number: int) -> Endpoint:
    return Endpoint("udp", str(number))


def give(parts: Reassembly, by: Endpoint, piece: int, now_ns: int = 0) -> bytes | None:
    header, body = PIECES[piece]
    return parts.receive(by, header, bytes(body), now_ns).packet


def test_fragments_of_two_senders_do_not_fit_together() -> None:
    parts = Reassembly()
    assert give(parts, endpoint(1), 0) is None
    with pytest.raises(MalformedError, match="out of order"):
        give(parts, endpoint(2), 1)
    assert parts.octets == 60
    assert give(parts, endpoint(1), 1) == PACKET
    assert (parts.octets, parts.dropped) == (0, 1)


def test_closed_ways_leave_nothing() -> None:
    parts = Reassembly()
    give(parts, endpoint(1), 0)
    parts.forget(endpoint(1))
    assert parts.octets == 0
    parts.forget(endpoint(1))


def test_senders_are_limited_and_the_late_ones_go_first() -> None:
    parts = Reassembly()
    late = FRAGMENT_TIMEOUT_NS + 1
    give(parts, endpoint(0), 0)
    give(parts, endpoint(1), 0, late)
    for number in range(2, MAX_SENDERS + 1):
        give(parts, endpoint(number), 0, late)
    assert give(parts, endpoint(1), 1, late) == PACKET
    give(parts, endpoint(1), 0, late)
    give(parts, endpoint(MAX_SENDERS + 1), 0, late)
    with pytest.raises(MalformedError):
        give(parts, endpoint(2), 1, late)
    assert parts.octets == 60 * MAX_SENDERS - 60


def test_octets_are_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reassembly, "MAX_OCTETS", 100)
    parts = Reassembly()
    give(parts, endpoint(1), 0)
    with pytest.raises(MalformedError, match="kept already"):
        give(parts, endpoint(2), 0)
    assert (parts.octets, parts.dropped) == (60, 1)
    assert give(parts, endpoint(1), 1) == PACKET
