from __future__ import annotations

import pytest

from devicebus.errors import BusError
from devicebus.mailbox.conversation import MailboxRequest
from devicebus.master.lane import Job, Lanes
from eap.codec.mailbox import MailboxType

COE, FOE = MailboxType.COE, MailboxType.FOE


def talk(kind, *, listen):
    yield MailboxRequest(kind, b"", listen=listen)


def job(name, requester="r", kind=COE, listen=False, ready_ns=0):
    conversation = talk(kind, listen=listen)
    made = Job(conversation, next(conversation), name, requester)
    made.ready_ns = ready_ns
    return made


def order(lanes, *, count):
    names = []
    for _ in range(count):
        taken = lanes.take(0)
        names.append(taken.task.name)
        taken.task.finish(None)
    return names


def test_requesters_take_turns():
    lanes = Lanes()
    for number in range(3):
        lanes.add(job(f"greedy{number}", "g"))
    lanes.add(job("a", "a"))
    lanes.add(job("b", "b"))
    assert order(lanes, count=5) == ["greedy0", "greedy1", "a", "b", "greedy2"]
    assert lanes.take(0) is None


def test_a_conversation_of_a_protocol_ends_before_the_next_begins():
    lanes = Lanes()
    lanes.add(job("first"))
    lanes.add(job("second", "s"))
    assert [lanes.take(0).task.name for _ in range(3)] == ["first"] * 3


def test_protocols_take_turns_message_by_message():
    lanes = Lanes()
    lanes.add(job("file", kind=FOE))
    lanes.add(job("sdo"))
    assert [lanes.take(0).task.name for _ in range(4)] == ["file", "sdo", "file", "sdo"]


def test_who_only_listens_goes_first():
    lanes = Lanes()
    lanes.add(job("file", kind=FOE))
    lanes.add(job("fragments", listen=True))
    assert [lanes.take(0).task.name for _ in range(3)] == ["fragments"] * 3


def test_who_waits_holds_nobody_up():
    lanes = Lanes()
    lanes.add(job("busy", kind=FOE, ready_ns=50))
    assert (lanes.take(49), lanes.next_ready()) == (None, 50)
    lanes.add(job("sdo"))
    assert lanes.take(49).task.name == "sdo"
    assert lanes.next_ready() == 0
    assert lanes.take(50).task.name == "busy"


def test_cancelled_conversations_are_passed_by():
    lanes = Lanes()
    jobs = [job(str(number)) for number in range(3)]
    for each in jobs:
        lanes.add(each)
    jobs[0].task.cancel()
    jobs[1].task.cancel()
    assert lanes.take(0) is jobs[2]
    jobs[2].task.cancel()
    assert (lanes.take(0), lanes.next_ready()) == (None, None)


def test_all_fail_at_once():
    lanes = Lanes()
    jobs = [job("a"), job("b"), job("c", kind=FOE)]
    for each in jobs:
        lanes.add(each)
    jobs[0].task.finish(1)
    lanes.fail_all("it is gone")
    assert jobs[0].task.result() == 1
    for each in jobs[1:]:
        with pytest.raises(BusError, match=f"{each.task.name}: it is gone"):
            each.task.result()
    assert lanes.take(0) is None


def test_each_protocol_has_its_own_judge():
    lanes = Lanes()
    assert lanes.judge(COE) is lanes.judge(COE)
    assert lanes.judge(COE) is not lanes.judge(FOE)
