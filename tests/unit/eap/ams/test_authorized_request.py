from __future__ import annotations

import struct

from eap.ads.endpoint import Endpoint
from eap.ads.operation import Read, Write
from eap.ads.request import AdsRequest, parse_request
from eap.ams.access import Decision
from eap.ams.access_filter import AuditedOperation, AuthorizedRequest
from eap.ams.spec import AccessService
from eap.codec.ads import IndexGroup
from eap.codec.ams import AmsCommand, AmsHeader
from eap.ids import NetId

WAY = Endpoint("ams-tcp", "10.0.0.5:49152")
HEADER = AmsHeader(NetId(b"\1\1\1\1\1\1"), 851, NetId(b"\2\2\2\2\1\1"), 30000, 9, 4)
READ = Decision(AccessService.READ, True, "")
WRITE = Decision(AccessService.WRITE, True, "")
DENIED = Decision(AccessService.WRITE, False, "")
ITEMS = (Write(1, 2, b"a"), Write(3, 4, b"b"), Write(5, 6, b"c"))
SUM = AdsRequest(AmsCommand.READ_WRITE, ITEMS, IndexGroup.SUM_WRITE, 12, 3)
MIXED = AuthorizedRequest(WAY, HEADER, "", SUM, (WRITE, DENIED, WRITE))


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


def test_what_is_told() -> None:
    read, piece = Read(1, 2, 3), Write(IndexGroup.FOE_WRITE, 7, b"a")
    files = Decision(AccessService.FILES, True, "")
    assert not AuditedOperation(read, READ, 0).is_audited
    assert AuditedOperation(read, READ._replace(is_allowed=False), 0x723).is_audited
    assert AuditedOperation(ITEMS[0], WRITE, None).is_audited
    assert not AuditedOperation(piece, files, 0).is_audited
    assert AuditedOperation(piece, files, 0x700).is_audited
    assert AuditedOperation(piece, files._replace(is_allowed=False), 0x723).is_audited
