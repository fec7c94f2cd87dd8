"""Access filter of a router, and the requests that it authorizes."""

from __future__ import annotations

import struct
from collections.abc import Iterator

from eap.ads.request import AdsRequest, Operation, Read, ReadWrite, Write, encode_sum, parse_request
from eap.ams.access import MAX_ENTRIES, AuditedOperation, AuditEntry, AuthorizedRequest, Decision
from eap.ams.inflight import RouterLimits
from eap.ams.record import Outcome
from eap.ams.spec import AccessRule, AccessService, ObjectRange
from eap.ams.transport_table import Deliver, Forward
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.ams import AmsAnswer, AmsCommand, AmsHeader
from eap.ids import Endpoint, NetId
from tests.support.ams import NOTIFICATION, READ, READ_WRITE, Ams
from tests.support.aoerouter import CLIENT, DEVICE, FAR, FAR_DEVICE, LINK, Station, route

WAY = Endpoint("ams-tcp", "10.0.0.5:49152")
HEADER = AmsHeader(NetId(b"\1\1\1\1\1\1"), 851, NetId(b"\2\2\2\2\1\1"), 30000, 9, 4)
READ_DECISION = Decision(AccessService.READ, True, "")
WRITE_DECISION = Decision(AccessService.WRITE, True, "")
DENIED = Decision(AccessService.WRITE, False, "")
ITEMS = (Write(1, 2, b"a"), Write(3, 4, b"b"), Write(5, 6, b"c"))
SUM = AdsRequest(AmsCommand.READ_WRITE, ITEMS, IndexGroup.SUM_WRITE, 12, 3)
MIXED = AuthorizedRequest(WAY, HEADER, "", SUM, (WRITE_DECISION, DENIED, WRITE_DECISION))


def test_part_of_a_sum() -> None:
    part = parse_request(AmsCommand.READ_WRITE, MIXED.encode_part())
    assert part.operations == (ITEMS[0], ITEMS[2])
    assert MIXED.denied == [DENIED]


def test_results_stand_beside_their_operations() -> None:
    body, entry = MIXED.complete(0, struct.pack("<4I", 0, 8, 0x706, 0))
    assert body == struct.pack("<5I", 0, 12, 0x706, 0x723, 0)
    assert [(each.operation, each.result) for each in entry.operations] == [
        (ITEMS[0], 0x706), (ITEMS[1], 0x723), (ITEMS[2], 0),
    ]  # fmt: skip


def test_an_answer_that_cannot_be_read_is_left_as_it_is() -> None:
    for body, result in ((b"", None), (struct.pack("<I", 0x705), 0x705)):
        got, entry = MIXED.complete(0, body)
        assert got == body
        assert [each.result for each in entry.operations] == [result, 0x723, result]


def test_audited_operations() -> None:
    read, piece = Read(1, 2, 3), Write(IndexGroup.FOE_WRITE, 7, b"a")
    files = Decision(AccessService.FILES, True, "")
    assert not AuditedOperation(read, READ_DECISION, 0).is_audited
    assert AuditedOperation(read, READ_DECISION._replace(is_allowed=False), 0x723).is_audited
    assert AuditedOperation(ITEMS[0], WRITE_DECISION, None).is_audited
    assert not AuditedOperation(piece, files, 0).is_audited
    assert AuditedOperation(piece, files, 0x700).is_audited
    assert AuditedOperation(piece, files._replace(is_allowed=False), 0x723).is_audited


G = IndexGroup
WRITE, WRITE_CONTROL = 3, 5
LAPTOP = Endpoint("tcp", "10.0.0.5:49152")
DRIVES = AccessRule("drives", networks=("10.0.0.0/24",), objects=(ObjectRange(0x8000, 0x8FFF),))
SDO_WRITE = struct.pack("<3I", G.SDO, 0x8000_0001, 2) + b"\1\2"
OTHER_WRITE = struct.pack("<3I", G.SDO, 0x9000_0001, 2) + b"\1\2"
SOME = (
    Write(G.SDO, 0x8000_0001, b"\1\2"),
    Write(G.SDO, 0x9000_0001, b"\3"),
    Write(G.SDO, 0x8FFF_0002, b"\4"),
)


def station(*rules: AccessRule) -> Station:
    return Station([route(FAR, LINK, "far")], rules=rules)


def ask(command: int, body: bytes, target: str = DEVICE, **more: int) -> Ams:
    return Ams(target, CLIENT, command=command, body=body, **more)


def sum_body(group: int, operations: tuple[Operation, ...], offset: int | None = None) -> bytes:
    count = len(operations) if offset is None else offset
    return encode_sum(AdsRequest(AmsCommand.READ_WRITE, operations, group, 1000, count))


def entries(which: Station) -> Iterator[AuditEntry]:
    return iter(which.router.access_filter.next_entry, None)


def results(entry: AuditEntry) -> list[int | None]:
    return [each.result for each in entry.operations]


class TestWhole:
    def test_filter_delivers_and_forwards_reads_without_audit(self) -> None:
        here = station()
        read = ask(READ, struct.pack("<3I", G.SDO, 0x1018_0001, 4))
        assert isinstance(here.give(read, LAPTOP)[0], Deliver)
        assert isinstance(here.give(read._replace(target=FAR_DEVICE), LAPTOP)[0], Forward)
        assert not list(entries(here))

    def test_filter_denies_and_audits_write_of_another_host(self) -> None:
        here = station()
        for target in (DEVICE, FAR_DEVICE):
            write = ask(WRITE, SDO_WRITE, target)
            assert here.replied(write, LAPTOP) == (LAPTOP, write.answer(b"", error=0x723))
        local, onward = entries(here)
        assert (local.route, onward.route) == ("", "far")
        assert results(local) == results(onward) == [0x723]
        outcomes = here.events()
        assert [outcome for outcome, _ in outcomes] == [Outcome.DENIED] * 2
        assert outcomes[0][1] == (
            f"WRITE of {DEVICE} for {CLIENT} (10.0.0.5:49152 by tcp):"
            " write refused: no rule allows it, and other hosts only read"
        )

    def test_filter_audits_allowed_write_with_result(self) -> None:
        here = station(DRIVES)
        delivered = here.delivered(ask(WRITE, SDO_WRITE), LAPTOP)
        here.router.receive_answer(delivered.ticket, AmsAnswer(b"\x06\x07\0\0"), 1)
        onward = here.forwarded(ask(WRITE, SDO_WRITE, FAR_DEVICE), LAPTOP)
        _, answer = here.replied(onward.answer(), LINK)
        assert answer.body == bytes(4)
        refused, done = entries(here)
        assert (results(refused), results(done)) == ([0x706], [0])
        assert done.operations[0].decision.why == "rule drives allows it"
        assert here.replied(ask(WRITE, OTHER_WRITE), LAPTOP)[1].error == 0x723

    def test_filter_answers_request_that_cannot_be_parsed(self) -> None:
        here = station()
        assert here.replied(ask(WRITE, b"\1\2"), LAPTOP)[1].body == b"\x05\x07\0\0"
        assert here.replied(ask(77, b""), LAPTOP)[1].error == 8
        assert not list(entries(here))
        anything = station(AccessRule("anything"))
        assert isinstance(anything.give(ask(77, b""), LAPTOP)[0], Deliver)

    def test_a_request_without_an_answer_is_judged_too(self) -> None:
        here = station(DRIVES)
        for target in (DEVICE, FAR_DEVICE):
            assert here.give(ask(WRITE, SDO_WRITE, target, flags=6), LAPTOP)
            assert not here.give(ask(WRITE, OTHER_WRITE, target, flags=6), LAPTOP)
        assert [results(each) for each in entries(here)] == [[None], [0x723], [None], [0x723]]

    def test_notifications_need_no_rule(self) -> None:
        body = struct.pack("<II", 4, 0)
        assert station(DRIVES).forwarded(ask(NOTIFICATION, body, FAR_DEVICE), LAPTOP).body == body


class TestNoAnswer:
    def test_filter_audits_write_to_lost_or_silent_hop(self) -> None:
        here = station(DRIVES)
        here.forwarded(ask(WRITE, SDO_WRITE, FAR_DEVICE), LAPTOP)
        here.router.hop_down(*LINK, "cable pulled", 5)
        here.router.hop_up(*LINK)
        here.forwarded(ask(WRITE, SDO_WRITE, FAR_DEVICE, invoke_id=2), LAPTOP)
        here.router.handle_timeout(10**10)
        assert [results(each) for each in entries(here)] == [[0x1B], [0x719]]

    def test_a_client_that_leaves(self) -> None:
        here = station(DRIVES)
        onward = here.forwarded(ask(WRITE, SDO_WRITE, FAR_DEVICE), LAPTOP)
        here.delivered(ask(WRITE, SDO_WRITE), LAPTOP)
        here.router.connection_closed(*LAPTOP, 5)
        here.give(onward.answer(), LINK)
        assert [results(each) for each in entries(here)] == [[None], [None]]

    def test_filter_audits_write_beyond_limits(self) -> None:
        here = Station(
            [route(FAR, LINK, "far")], rules=[DRIVES], limits=RouterLimits(per_connection=1)
        )
        here.forwarded(ask(WRITE, SDO_WRITE, FAR_DEVICE), LAPTOP)
        for target in (DEVICE, FAR_DEVICE):
            second = ask(WRITE, SDO_WRITE, target, invoke_id=2)
            assert here.replied(second, LAPTOP)[1].error == AdsError.MAILBOX_FULL
        assert [results(each) for each in entries(here)] == [[AdsError.MAILBOX_FULL]] * 2


class TestSums:
    def test_filter_decides_on_sum_items_at_every_hop(self) -> None:
        here = station(DRIVES)
        body = sum_body(G.SUM_WRITE, SOME)
        kept = sum_body(G.SUM_WRITE, SOME[::2])
        came = struct.pack("<4I", 0, 8, 0, 0x706)
        merged = struct.pack("<5I", 0, 12, 0, 0x723, 0x706)

        delivered = here.delivered(ask(READ_WRITE, body), LAPTOP)
        assert delivered.body == kept
        (reply,) = here.router.receive_answer(delivered.ticket, AmsAnswer(came), 1)
        assert reply.packets[0][32:] == merged

        onward = here.forwarded(ask(READ_WRITE, body, FAR_DEVICE), LAPTOP)
        assert onward.body == kept
        assert here.replied(onward.answer(came), LINK)[1].body == merged
        assert [results(each) for each in entries(here)] == [[0, 0x723, 0x706]] * 2
        assert [text.split(": ", 1)[1] for _, text in here.events()] == [
            (
                "1 of 3 items refused, the first: write refused:"
                " no rule allows it, and other hosts only read"
            )
        ] * 2

    def test_all_items_refused(self) -> None:
        here = station()
        _, answer = here.replied(ask(READ_WRITE, sum_body(G.SUM_WRITE, SOME)), LAPTOP)
        assert (answer.error, answer.body) == (0, struct.pack("<5I", 0, 12, *[0x723] * 3))
        assert [results(each) for each in entries(here)] == [[0x723] * 3]

    def test_a_sum_that_fails_as_a_whole(self) -> None:
        here = station(DRIVES)
        onward = here.forwarded(ask(READ_WRITE, sum_body(G.SUM_WRITE, SOME), FAR_DEVICE), LAPTOP)
        assert here.replied(onward.answer(b"", error=6), LINK)[1].error == 6
        assert [results(each) for each in entries(here)] == [[6, 0x723, 6]]

    def test_a_sum_read_without_results_is_refused_as_a_whole(self) -> None:
        hidden = AccessRule("hidden", allow=False, objects=(ObjectRange(0x1018, 0x1018),))
        reads = (Read(G.SDO, 0x1000_0000, 4), Read(G.SDO, 0x1018_0001, 4))
        here = station(hidden)
        body = sum_body(G.SUM_READ, reads, 0)
        assert here.replied(ask(READ_WRITE, body), LAPTOP)[1].error == 0x723
        delivered = here.delivered(ask(READ_WRITE, sum_body(G.SUM_READ, reads)), LAPTOP)
        assert delivered.body == sum_body(G.SUM_READ, reads[:1])

    def test_filter_does_not_audit_sums_of_reads(self) -> None:
        here = station()
        body = sum_body(G.SUM_READ, (Read(G.SDO, 0x1018_0001, 4),) * 3)
        here.delivered(ask(READ_WRITE, body), LAPTOP)
        assert not list(entries(here))


class TestRequiredRecord:
    """Changes that have to be recorded before they are done."""

    def test_filter_delivers_change_after_recording(self) -> None:
        here, recorded = station(DRIVES), []
        here.router.access_filter.before_change = lambda entry: recorded.append(entry) or ""
        assert isinstance(here.give(ask(WRITE, SDO_WRITE), LAPTOP)[0], Deliver)
        assert isinstance(here.give(ask(READ, SDO_WRITE[:12]), LAPTOP)[0], Deliver)
        assert [results(each) for each in recorded] == [[None]]

    def test_change_that_cannot_be_recorded_is_refused_here_and_at_hops(self) -> None:
        here = station(DRIVES)
        here.router.access_filter.before_change = lambda _: "the audit cannot be written"
        for target in (DEVICE, FAR_DEVICE):
            assert here.replied(ask(WRITE, SDO_WRITE, target), LAPTOP)[1].error == 0x723
        assert here.events()[0][1].endswith("write refused: the audit cannot be written")
        assert [results(each) for each in entries(here)] == [[0x723], [0x723]]

    def test_sum_command_keeps_its_reads(self) -> None:
        here = station(DRIVES, AccessRule("all"))
        here.router.access_filter.before_change = lambda _: "the audit cannot be written"
        body = sum_body(G.SUM_READ_WRITE, (
            ReadWrite(G.SYMBOL_HANDLE, 0, 4, b"x"), ReadWrite(G.SDO, 0x8000_0001, 4, b"\1"),
        ))  # fmt: skip
        delivered = here.delivered(ask(READ_WRITE, body), LAPTOP)
        assert len(delivered.body) < len(body)

    def test_request_that_cannot_be_read_cannot_be_recorded(self) -> None:
        here = station(AccessRule("anything"))
        here.router.access_filter.before_change = lambda _: ""
        assert here.replied(ask(77, b""), LAPTOP)[1].error == 8


class TestFiles:
    def test_filter_audits_file_blocks_only_on_failure(self) -> None:
        here = station(AccessRule("anything"))
        for body, result in (
            (struct.pack("<4I", G.FOE_OPEN_WRITE, 0, 4, 1) + b"a", 0),
            (struct.pack("<4I", G.FOE_WRITE, 7, 0, 1) + b"a", 0),
            (struct.pack("<4I", G.FOE_WRITE, 7, 0, 1) + b"a", 0x700),
        ):
            delivered = here.delivered(ask(READ_WRITE, body), LAPTOP)
            here.router.receive_answer(delivered.ticket, AmsAnswer(struct.pack("<I", result)), 1)
        told = [(each.operations[0].operation.group, *results(each)) for each in entries(here)]
        assert told == [(G.FOE_OPEN_WRITE, 0), (G.FOE_WRITE, 0x700)]


def test_filter_audit_queue_is_bounded() -> None:
    here = station()
    for _ in range(MAX_ENTRIES + 3):
        here.give(ask(WRITE, SDO_WRITE), LAPTOP)
    assert len(list(entries(here))) == MAX_ENTRIES
