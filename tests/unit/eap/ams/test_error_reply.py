from __future__ import annotations

from eap.ams.error_reply import ErrorReplier, RoutingError
from eap.ams.record import Outcome, Record
from eap.ams.routes import Route
from eap.ams.transport_table import Transport, TransportTable
from eap.codec.ads import AdsError
from eap.codec.ams import AmsHeader
from eap.ids import Endpoint, NetId
from tests.support.ams import Ams
from tests.support.aoerouter import only_reply

WAY, HOP = Endpoint("tcp", "1"), Endpoint("link", "6")
ASKED = Ams("6.1.1.1.1.1:1", "7.1.1.1.1.1:2")
HEADER = AmsHeader.decode(ASKED.octets())
ROUTE = Route(NetId.parse("6.1.1.1.1.1"), "far", HOP)
WHY = RoutingError(AdsError.HOST_UNREACHABLE, "the cable is cut", ROUTE)


def test_refusal_is_answered_counted_and_traced() -> None:
    record = Record()
    error_replier = ErrorReplier(TransportTable([Transport("tcp")]), record)
    assert only_reply(error_replier.reply_error(HEADER, WAY, WHY, 9, 4)) == (
        WAY,
        ASKED.answer(b"", 0x1B),
    )
    trace = record.next_event()
    assert trace is not None
    assert (trace.at_ns, trace.outcome) == (9, Outcome.FAILED)
    assert (trace.endpoint, trace.hop) == (WAY, HOP)
    assert (trace.error_code, trace.took_ns) == (0x1B, 4)
    assert trace.text == f"READ of {ASKED.target} for {ASKED.source} ({WAY}): the cable is cut"
    assert record.connections.of(WAY, 9).last_error == "the cable is cut"
    assert record.routes.of(ROUTE.key, 9).errors == 1


def test_error_replier_sends_nothing_without_waiting_client() -> None:
    error_replier = ErrorReplier(TransportTable([Transport("tcp")]), Record())
    assert error_replier.reply_error(HEADER, None, WHY, 9) == []


def test_dropped_packets_are_traced() -> None:
    record = Record()
    error_replier = ErrorReplier(TransportTable([]), record)
    assert error_replier.drop(WAY, None, Outcome.DROPPED, "broken", 3) == []
    assert error_replier.drop(WAY, HEADER, Outcome.LOOP, "again", 3) == []
    assert [each.text for each in iter(record.next_event, None)] == [
        "1 by tcp: broken", f"READ of {ASKED.target} for {ASKED.source} ({WAY}): again"
    ]  # fmt: skip
