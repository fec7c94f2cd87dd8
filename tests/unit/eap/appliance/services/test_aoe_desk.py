"""Who answers an AMS packet, and how what nobody answers comes back."""

from __future__ import annotations

import asyncio
from contextlib import suppress

import pytest

from eap.aoe.answer import AmsAnswer
from eap.aoe.fragment import Assembler, iter_fragments
from eap.appliance.services import aoe_desk
from eap.appliance.services.aoe_desk import DEVICE_PORT, AoeDesk, AoeDoor
from eap.codec.ads import AdsError
from eap.codec.ams import AmsCommand, AmsHeader, StateFlags, decode_packet, encode_packet
from eap.ids import NetId

EAP0, BUS0, ROUTER, OTHER, CLIENT = map(
    NetId.parse, ("1.1.1.1.2.1", "1.1.1.1.3.1", "1.1.1.1.1.1", "2.2.2.2.2.2", "9.9.9.9.1.1")
)
ROOM = 100


async def echo(command: int, data: bytes) -> AmsAnswer:
    return AmsAnswer(bytes([command]) + data[::-1])


def request(
    body: bytes = b"abc",
    *,
    target=EAP0,
    port=DEVICE_PORT,
    command=AmsCommand.READ,
    flags=0,
    number=5,
) -> bytes:
    header = AmsHeader(
        target, port, CLIENT, 33000, command, StateFlags.ADS | flags, invoke_id=number
    )
    return encode_packet(header, body)


class Talk:
    """A door to the desks of a few stations, and what comes back through it."""

    def __init__(self, *desks: AoeDesk) -> None:
        self.desks = desks or (AoeDesk({EAP0: echo}, {EAP0, BUS0, ROUTER}),)
        self.door = AoeDoor(self.desks, ROOM)
        self.packets: list[bytes] = []

    def tell(self, *packets: bytes, for_all: bool = False) -> list[bool]:
        async def talk():
            async with asyncio.TaskGroup() as group:
                tasks = [group.create_task(desk.serve()) for desk in self.desks]
                taken = [
                    self.door.receive_packet(each, self.packets.append, 0, for_all=for_all)
                    for each in packets
                ]
                for _ in range(10 * len(packets) + 10):
                    await asyncio.sleep(0)
                for task in tasks:
                    task.cancel()
                return taken

        return asyncio.run(talk())

    def errors(self) -> list[int]:
        return [decode_packet(each)[0].error_code for each in self.packets]


def test_request_is_answered():
    talk = Talk()
    assert talk.tell(request()) == [True]
    header, body = decode_packet(talk.packets[0])
    assert bytes(body) == b"\2cba"
    assert (header.target, header.target_port) == (CLIENT, 33000)
    assert (header.source, header.source_port) == (EAP0, DEVICE_PORT)
    assert (header.state_flags, header.invoke_id, header.error_code) == (5, 5, 0)


@pytest.mark.parametrize(
    ("packet", "error"),
    [
        (request(target=OTHER), AdsError.TARGET_MACHINE),
        (request(target=BUS0), AdsError.TARGET_PORT),
        (request(target=ROUTER), AdsError.TARGET_PORT),
        (request(port=1001), AdsError.TARGET_PORT),
        (request(command=0x77), AdsError.COMMAND),
    ],
)
def test_what_nobody_answers_comes_back_with_the_reason(packet, error):
    talk = Talk()
    assert talk.tell(packet) == [True]
    header, body = decode_packet(talk.packets[0])
    assert (header.error_code, bytes(body), header.length) == (error, b"", 0)
    assert header.state_flags & StateFlags.RESPONSE


def test_desk_of_any_station_behind_the_door_answers():
    talk = Talk(AoeDesk({EAP0: echo}, {EAP0}), AoeDesk({OTHER: echo}, {OTHER}))
    talk.tell(request(target=OTHER), request(), request(target=BUS0))
    assert talk.errors() == [AdsError.TARGET_MACHINE, 0, 0]  # errors do not wait


def test_multicast_is_answered_by_who_is_meant_only():
    talk = Talk()
    talk.tell(request(target=OTHER), request(), request(target=BUS0), for_all=True)
    assert talk.errors() == [AdsError.TARGET_PORT, 0]


def test_answer_that_is_not_wanted_is_not_sent():
    talk = Talk()
    assert talk.tell(request(flags=StateFlags.NO_RETURN)) == [True]
    assert talk.packets == []


@pytest.mark.parametrize(
    "packet", [b"", request()[:31], request()[:-1], request(flags=StateFlags.RESPONSE)]
)
def test_what_is_no_request_is_not_taken(packet):
    talk = Talk()
    assert talk.tell(packet) == [False]
    assert talk.packets == []


def test_long_packets_come_and_go_in_fragments():
    talk = Talk()
    talk.tell(*iter_fragments(request(b"x" * 300), 7, 50))
    assert all(len(each) <= ROOM for each in talk.packets)
    back = Assembler()
    whole = [
        taken.packet
        for each in talk.packets
        if (taken := back.receive(decode_packet(each)[0], each[AmsHeader.SIZE :], 0)).packet
    ]
    header, body = decode_packet(whole[0])
    assert bytes(body) == b"\2" + b"x" * 300
    assert header.invoke_id == 5


def test_fragments_are_acknowledged_if_their_sender_waits():
    talk = Talk()
    fragments = []
    for fragment in iter_fragments(request(b"y" * 60), 7, 50):
        header, body = decode_packet(fragment)
        waits = AmsHeader(
            header.target,
            header.target_port,
            header.source,
            header.source_port,
            header.command,
            StateFlags.ADS,
            invoke_id=header.invoke_id,
        )
        fragments.append(encode_packet(waits, body))
    talk.tell(*fragments)
    commands = [decode_packet(each)[0].command for each in talk.packets]
    assert commands == [AmsCommand.FRAGMENT, AmsCommand.READ]


def test_fragment_out_of_order_is_not_taken():
    talk = Talk()
    second = list(iter_fragments(request(b"x" * 300), 7, 50))[1]
    assert talk.tell(second) == [False]


def test_requests_of_a_station_are_done_one_after_the_other():
    order = []

    async def slow(command: int, data: bytes) -> AmsAnswer:
        order.append(("begin", data))
        await asyncio.sleep(0)
        order.append(("end", data))
        return AmsAnswer(data)

    Talk(AoeDesk({EAP0: slow}, {EAP0})).tell(request(b"1"), request(b"2"))
    assert order == [("begin", b"1"), ("end", b"1"), ("begin", b"2"), ("end", b"2")]


def test_crowd_is_turned_away(monkeypatch):
    monkeypatch.setattr(aoe_desk, "MAX_WAITING", 2)
    talk = Talk()
    talk.tell(*(request(number=number) for number in range(4)))
    assert talk.errors() == [AdsError.MAILBOX_FULL] * 2 + [0, 0]


def test_request_that_fails_inside_is_answered_and_the_next_one_served(caplog):
    async def fail(command: int, data: bytes) -> AmsAnswer:
        raise ZeroDivisionError

    talk = Talk(AoeDesk({EAP0: fail, OTHER: echo}, {EAP0, OTHER}))
    talk.tell(request(), request(target=OTHER))
    assert talk.errors() == [AdsError.INTERNAL, 0]
    assert f"AoE request from {CLIENT} failed" in caplog.text


def test_cancelled_while_it_serves():
    async def never(command: int, data: bytes) -> AmsAnswer:
        await asyncio.Event().wait()
        raise AssertionError

    talk = Talk(AoeDesk({EAP0: never}, {EAP0}))
    with suppress(asyncio.CancelledError):
        talk.tell(request())
    assert talk.packets == []


def test_those_who_may_wait_take_turns_with_those_who_may_not():
    under_way = []

    async def slow(command: int, data: bytes) -> AmsAnswer:
        under_way.append(data)
        await asyncio.sleep(0.01)
        assert under_way == [data]
        under_way.clear()
        if data == b"bad":
            raise ZeroDivisionError
        return AmsAnswer(data)

    async def script():
        desk = AoeDesk({EAP0: slow}, {EAP0})
        header, _ = decode_packet(request())
        serving = asyncio.ensure_future(desk.serve())
        answers = []
        desk.put(header, b"put", slow, answers.append)
        answers += await asyncio.gather(
            *(desk.ask(header, body, slow) for body in (b"a", b"bad", b"b"))
        )
        await desk.wait_idle()
        serving.cancel()
        return answers

    answers = asyncio.run(script())
    assert sorted(answers, key=lambda answer: answer.data) == [
        AmsAnswer(error_code=AdsError.INTERNAL),
        AmsAnswer(b"a"),
        AmsAnswer(b"b"),
        AmsAnswer(b"put"),
    ]
