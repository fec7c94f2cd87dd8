"""The master's dictionary for one client."""

from __future__ import annotations

import pytest

from eap.codec.mailbox import MailboxType
from eap.gateway.error_table import Cause
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import RW, variable
from eap.services.gateway.sessions import MasterSession
from tests.support.virtualtime import run_virtual

COE = MailboxType.COE


async def nothing(index: int) -> None:
    """All that the dictionary shows is up to date."""


def session(room: int = 100) -> MasterSession:
    return MasterSession(
        ObjectDictionary([variable(0x2000, "A", "UDINT", RW)]), room, nothing, lambda index: True
    )


def test_segments_of_two_clients_do_not_meet() -> None:
    objects = ObjectDictionary([variable(0x1008, "N", "STRING(200)", value="n" * 200)])
    first, second = (MasterSession(objects, 100, nothing, lambda index: True) for _ in range(2))
    upload = bytes.fromhex("0020 40 0810 00 00000000")
    (head,) = run_virtual(first.handle(COE, upload))
    assert head.body[2] == 0x41
    (other,) = run_virtual(second.handle(COE, bytes.fromhex("0020 60 00000000000000")))
    assert other.body[2] == 0x80
    (segment,) = run_virtual(first.handle(COE, bytes.fromhex("0020 60 00000000000000")))
    assert segment.body[2] >> 5 == 0
    first.close()
    (segment,) = run_virtual(first.handle(COE, bytes.fromhex("0020 70 00000000000000")))
    assert segment.body[2] == 0x80


def test_master_session_refuses_other_protocols() -> None:
    (reply,) = run_virtual(session().handle(MailboxType.FOE, b"\1\0\0\0\0\0f"))
    assert (reply.type, reply.reason) == (MailboxType.FOE, Cause.NO_PROTOCOL)
    assert reply.body[:6] == bytes.fromhex("0500 00800000")
    (reply,) = run_virtual(session().handle(MailboxType.SOE, bytes.fromhex("01 40 2000")))
    assert (reply.type, reply.reason) == (MailboxType.SOE, Cause.NO_PROTOCOL)
    assert reply.body == bytes.fromhex("12 40 2000 0110")
    (reply,) = run_virtual(session().handle(MailboxType.VOE, bytes(6)))
    assert (reply.type, reply.reason) == (MailboxType.ERR, Cause.NO_PROTOCOL)
    (reply,) = run_virtual(session().handle(COE, b"\0"))
    assert (reply.type, reply.body) == (MailboxType.ERR, bytes.fromhex("0100 0600"))
    (reply,) = run_virtual(session().handle(COE, bytes.fromhex("0020 40 0020 01 0000")))
    assert (reply.type, reply.body) == (COE, bytes.fromhex("0020 80 0020 01 01000405"))


def test_master_session_reads_and_writes_objects() -> None:
    one = session()
    one.write(0x2000, 0, bytes(4))
    assert run_virtual(one.read(0x2000, 0, complete=False)) == bytes(4)
    with pytest.raises(SdoAbortError) as caught:
        run_virtual(one.read(0x3000, 0, complete=False))
    assert caught.value.code == AbortCode.NO_OBJECT
