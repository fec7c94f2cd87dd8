"""Every mailbox protocol between master and slave at once, while frames are lost, come twice and
overtake each other: what was written is read, and nobody gets the answer of another."""

from __future__ import annotations

import heapq
import io
from collections.abc import Callable, Generator
from ipaddress import IPv4Address
from itertools import count
from random import Random

from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from devicebus.mailbox import aoe_client, coe_client, eoe, foe_client, soe_client, voe
from devicebus.mailbox.conversation import Conversation
from devicebus.master.procedure import Task
from devicebus.sim.segment import SegmentEnd, SimulatedSegment
from devicebus.sim.spec import FileSpec, MailboxSpec, ObjectSpec
from eap.codec.ads import AdsRange, IndexGroup
from eap.codec.ams import AmsCommand, AmsHeader
from eap.codec.eoe import IpSettings
from eap.codec.soe import Idn, encode_list
from eap.ids import NetId
from tests.support.busline import MS, POLL_NS, TRIP_NS, Bench, Line, open_mailbox, segment, slave
from tests.support.examples import examples

LONGEST_TRIP_NS = 800_000
"""Of a frame on its way to the slaves, and on its way back; less than a master waits for both."""
LIST = Idn.parse("S-0-0016")
HERE, THERE = NetId.parse("1.2.3.4.5.6"), NetId.parse("127.0.0.1.3.1")
BLOCK, COUNT = 0x8000, 0x8001


class RoughLine(Line):
    """A line that loses frames, brings answers twice, and lets frames overtake each other."""

    def __init__(self, core: Bench, line_segment: SimulatedSegment, dice: Random) -> None:
        super().__init__(core, line_segment)
        self.dice = dice
        self.is_rough = False
        self._under_way: list[tuple[int, int, bool, bytes]] = []
        self._number = count()

    def step(self, until_ns: int) -> None:
        for frame in self.core.frames_to_send(self.now_ns):
            self._send(frame, is_back=False)
        first = self._under_way[0][0] if self._under_way else until_ns
        times = (first, self.core.next_timeout(), self.now_ns + POLL_NS, until_ns)
        self.now_ns = max(self.now_ns, min(at for at in times if at is not None))
        while self._under_way and self._under_way[0][0] <= self.now_ns:
            _, _, is_back, octets = heapq.heappop(self._under_way)
            if is_back:
                self.core.receive_frame(octets, self.now_ns)
                continue
            passing = bytearray(octets)
            if self.segment.process_frame(passing, self.now_ns) is SegmentEnd.PRIMARY:
                self._send(bytes(passing), is_back=True)
                if self.is_rough and self.dice.random() < 0.1:
                    self._send(bytes(passing), is_back=True)
        self.segment.handle_timeout(self.now_ns)
        self.core.handle_timeout(self.now_ns)

    def _send(self, octets: bytes, *, is_back: bool) -> None:
        if self.is_rough and self.dice.random() < 0.08:
            return
        slow = self.is_rough and self.dice.random() < 0.3
        trip_ns = self.dice.randrange(TRIP_NS, LONGEST_TRIP_NS) if slow else TRIP_NS
        item = (self.now_ns + trip_ns, next(self._number), is_back, octets)
        heapq.heappush(self._under_way, item)


def ads(command: int, invoke_id: int, offset: int, size: int, data: bytes = b"") -> tuple:
    header = AmsHeader(THERE, 1001, HERE, 300, command, invoke_id=invoke_id)
    return header, AdsRange(IndexGroup.SDO, offset, size).encode() + data


def then(talk: Conversation, change: Callable[[object], object]) -> Conversation:
    """A conversation whose result is changed."""
    return change((yield from talk))


class MailboxMachine(RuleBasedStateMachine):
    """Requests of all protocols, several at once; those of one protocol are done in order."""

    def __init__(self) -> None:
        super().__init__()
        device = slave(
            "drive",
            kind="drive",
            mailbox=MailboxSpec(size=48, foe=True, soe=True, eoe=True, voe=True, aoe=True),
            files=(FileSpec(name="f"),),
            objects=(
                ObjectSpec(index=BLOCK, name="block", type="BLOCK(150)"),
                ObjectSpec(index=COUNT, name="count", type="UDINT"),
            ),
        )
        self.line = RoughLine(Bench(), segment(device), Random(5))
        self.box = open_mailbox(self.line)
        self.running: list[tuple[Task, object]] = []
        self.block, self.count = bytes(150), bytes(4)
        self.file, self.list, self.ip = b"", encode_list(bytes(4), 32), IpSettings()
        self.invoke_ids = count(1)
        self.start(soe_client.write(LIST, encode_list(b""), self.box.sizes), None)
        self.list = encode_list(b"", 32)

    @initialize(seed=st.integers(0, 1 << 16))
    def roughen(self, seed: int) -> None:
        self.line.dice.seed(seed)
        self.line.is_rough = True

    def start(self, talk: Generator, expected: object) -> None:
        self.running.append((self.box.converse(talk, self.line.now_ns), expected))

    @rule(data=st.binary(min_size=150, max_size=150))
    def coe_write(self, data: bytes) -> None:
        self.start(coe_client.download(BLOCK, 0, data, self.box.sizes), None)
        self.block = data

    @rule()
    def coe_read(self) -> None:
        self.start(coe_client.upload(BLOCK, 0), self.block)

    @rule()
    def coe_list(self) -> None:
        """In fragments, and the same each time."""
        self.start(then(coe_client.object_list(), lambda found: BLOCK in found), True)

    @rule(data=st.binary(max_size=200))
    def foe_write(self, data: bytes) -> None:
        source = io.BytesIO(data)
        self.start(foe_client.write("f", source.read, self.box.sizes), len(data))
        self.file = data

    @rule()
    def foe_read(self) -> None:
        sink = io.BytesIO()
        talk = foe_client.read("f", sink.write, self.box.sizes)
        self.start(then(talk, lambda size: (size, sink.getvalue())), (len(self.file), self.file))

    @rule(data=st.binary(max_size=16))
    def soe_write(self, data: bytes) -> None:
        octets = 2 * data
        self.start(soe_client.write(LIST, encode_list(octets), self.box.sizes), None)
        self.list = encode_list(octets, 32)

    @rule()
    def soe_read(self) -> None:
        self.start(soe_client.read(LIST), self.list)

    @rule(address=st.integers(0, 0xFFFFFFFF))
    def eoe_write(self, address: int) -> None:
        self.ip = IpSettings(ip=IPv4Address(address))
        self.start(eoe.set_ip(self.ip), None)

    @rule()
    def eoe_read(self) -> None:
        self.start(eoe.get_ip(), self.ip)

    @rule(data=st.binary(max_size=36), kind=st.integers(0, 3))
    def voe(self, data: bytes, kind: int) -> None:
        self.start(voe.exchange(0xE5A, kind, data), data)

    @rule(data=st.binary(min_size=4, max_size=4))
    def aoe_write(self, data: bytes) -> None:
        packet = ads(AmsCommand.WRITE, next(self.invoke_ids), COUNT << 16, 4, data)
        talk = aoe_client.exchange(*packet, self.box.sizes)
        self.start(then(talk, lambda answer: answer[1]), bytes(4))
        self.count = data

    @rule()
    def aoe_read(self) -> None:
        packet = ads(AmsCommand.READ, next(self.invoke_ids), COUNT << 16, 4)
        talk = aoe_client.exchange(*packet, self.box.sizes)
        self.start(then(talk, lambda answer: answer[1][8:]), self.count)

    @rule(milliseconds=st.integers(0, 20))
    def cancel_a_read(self, milliseconds: int) -> None:
        talks = [coe_client.upload(BLOCK, 0), coe_client.object_list(), soe_client.read(LIST)]
        tasks = [self.box.converse(talk, self.line.now_ns, requester="hasty") for talk in talks]
        self.line.elapse(milliseconds * MS)
        for task in tasks:
            task.cancel()

    @rule(milliseconds=st.integers(0, 50))
    def elapse(self, milliseconds: int) -> None:
        self.line.elapse(milliseconds * MS)

    @invariant()
    def everybody_gets_his_own(self) -> None:
        waiting = []
        for task, expected in self.running:
            if task.is_done:
                assert task.result() == expected
            else:
                waiting.append((task, expected))
        self.running = waiting

    def teardown(self) -> None:
        for task, expected in self.running:
            assert self.line.wait(task) == expected
        stats = self.box.stats()
        assert stats.timeouts == stats.errors == stats.malformed == stats.gaps == 0


TestMailboxMachine = MailboxMachine.TestCase
TestMailboxMachine.settings = examples(20, stateful_step_count=20)
