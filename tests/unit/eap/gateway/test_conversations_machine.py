"""Any order of replies, losses, repeats and time-outs: each request ends once, with its own data.

The gateway of this test executes whatever arrives, also twice; its replies arrive in any order, up
to the time for a reply after the request was last sent.
"""

from __future__ import annotations

import struct
from typing import Any

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from devicebus.errors import BusError, MailboxRefusedError, MailboxTimeoutError
from devicebus.mailbox import coe_client, foe_client, voe
from devicebus.mailbox.conversation import Conversation
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.mailbox import (
    MailboxErrorReply,
    MailboxHeader,
    MailboxType,
    decode_frame,
    encode_frame,
)
from eap.errors import EapError
from eap.gateway.conversations import GatewayConversation, GatewayConversations, PendingRequest
from eap.od.abort import SdoAbortError

TIMEOUT_NS = 1_000_000_000
TRIES = 3
SHORT, LONG, MISSING = 0x2000, 0x3000, 0x4000
ADDRESSES = (1001, 1002)
REFUSING = 1001
"""The slave that refuses VoE, by a mailbox error."""
SIZES = MailboxSizes(48, 48)
KINDS = ("short", "long", "missing", "write", "file", "vendor")


class Slave:
    """Executes requests; what it returns names itself and the execution."""

    def __init__(self, address: int) -> None:
        self.address = address
        self.executions = 0
        self.written: list[bytes] = []
        self._content = b""
        self._toggle = 0
        self._opened = self._read_by = 0
        self._last: tuple[bytes, bytes] = b"", b""

    def stamp(self, execution: int) -> bytes:
        return struct.pack("<HH", self.address, execution)

    def whole(self, execution: int) -> bytes:
        return self.stamp(execution) * 6

    def file(self, execution: int) -> bytes:
        return self.stamp(execution) * 20

    def execute(
        self, kind: MailboxType, body: bytes, counter: int
    ) -> tuple[MailboxType, bytes] | None:
        if kind is MailboxType.VOE:
            if self.address == REFUSING:
                return MailboxType.ERR, MailboxErrorReply(detail=2).encode()
            return kind, body
        reply = self._sdo(body) if kind is MailboxType.COE else self._foe(body, counter)
        return None if reply is None else (kind, reply)

    def _sdo(self, body: bytes) -> bytes | None:
        index = int.from_bytes(body[3:5], "little")
        service = body[2] >> 5
        if service == 4:  # an abort is not answered
            self._content = b""
            return None
        if service == 3:
            if body != self._last[0]:  # the same one again has the same answer
                self._last = body, self._segment(body[2] >> 4 & 1)
            return self._last[1]
        if service == 1:
            self.written.append(body[6:10])
            return struct.pack("<HBHBI", 3 << 12, 0x60, index, body[5], 0)
        if index == MISSING:
            return struct.pack("<HBHBI", 2 << 12, 0x80, index, body[5], 0x06020000)
        self.executions += 1
        if index == SHORT:
            return struct.pack("<HBHB", 3 << 12, 0x43, index, body[5]) + self.stamp(self.executions)
        self._content, self._toggle, self._last = self.whole(self.executions), 0, (b"", b"")
        return struct.pack("<HBHBI", 3 << 12, 0x41, index, body[5], len(self._content))

    def _segment(self, toggle: int) -> bytes:
        if not self._content or toggle != self._toggle:
            return struct.pack("<HBHBI", 2 << 12, 0x80, 0, 0, 0x05030000)
        piece, self._content = self._content[:8], self._content[8:]
        self._toggle ^= 1
        return struct.pack("<HB", 3 << 12, toggle << 4 | (not self._content)) + piece

    def _foe(self, body: bytes, counter: int) -> bytes | None:
        number = int.from_bytes(body[2:6], "little")
        if body[0] == 5:
            self._read_by = 0
            return None
        if body[0] == 1:
            if self._read_by != counter:  # otherwise the same datagram once more
                self.executions += 1
                self._opened = self.executions
            self._read_by, number = counter, 0
        else:
            self._read_by = 0
        room = SIZES.to_master - 12
        packet = self.file(self._opened)[number * room : (number + 1) * room]
        is_past_end = number * room > len(self.file(self._opened))
        return None if is_past_end else struct.pack("<BBI", 3, 0, number + 1) + packet


class Run:
    """One conversation, stepped by hand, and the state of its slave when it began."""

    def __init__(self, kind: str, slave: Slave, number: int) -> None:
        self.kind = kind
        self.slave = slave
        self.place = GatewayConversation(slave.address)
        self.data = number.to_bytes(4, "little")
        self.executions: int | None = None
        """Executions of its slave before it sent anything."""
        self.file = bytearray()
        self.ends = 0
        self.result: Any = None
        self.error: EapError | None = None
        self.conversation: Conversation[Any] = {
            "short": lambda: coe_client.upload(SHORT, 0),
            "long": lambda: coe_client.upload(LONG, 0),
            "missing": lambda: coe_client.upload(MISSING, 0),
            "write": lambda: coe_client.download(SHORT, 0, self.data, SIZES),
            "file": lambda: foe_client.read("f", self.file.extend, SIZES),
            "vendor": lambda: voe.exchange(5, 1, self.data),
        }[kind]()

    def check(self) -> None:
        """Compare what it ended with to what its slave did for it."""
        assert self.ends == 1
        new = range((self.executions or 0) + 1, self.slave.executions + 1)
        if isinstance(self.error, MailboxRefusedError):
            assert (self.kind, self.slave.address) == ("vendor", REFUSING)
        elif isinstance(self.error, SdoAbortError):
            assert self.kind == "missing"
        elif self.error is not None:
            assert isinstance(self.error, MailboxTimeoutError), self.error
        elif self.kind == "short":
            assert self.result in [self.slave.stamp(each) for each in new]
        elif self.kind == "long":
            assert self.result in [self.slave.whole(each) for each in new]
        elif self.kind == "file":
            assert bytes(self.file) in [self.slave.file(each) for each in new]
        elif self.kind == "write":
            assert self.data in self.slave.written
        else:
            assert (self.kind, self.result) == ("vendor", self.data)


class ConversationsMachine(RuleBasedStateMachine):
    def __init__(self) -> None:
        super().__init__()
        self.now_ns = 1
        self.core = GatewayConversations(timeout_ns=TIMEOUT_NS, tries=TRIES, silence="silent")
        self.slaves = {address: Slave(address) for address in ADDRESSES}
        self.running: dict[PendingRequest, Run] = {}
        self.ended: list[Run] = []
        self.replies: list[tuple[bytes, PendingRequest | None]] = []
        """Replies on their way, each with the request that it belongs to."""
        self.sent_ns: dict[PendingRequest | None, int] = {}
        self.number = 0
        self.losses: list[bool] = []

    @rule(kind=st.sampled_from(KINDS), address=st.sampled_from(ADDRESSES))
    def start(self, kind: str, address: int) -> None:
        self.number += 1
        run = Run(kind, self.slaves[address], self.number)
        self.step(run, lambda: next(run.conversation))

    @rule(losses=st.lists(st.booleans(), max_size=4))
    def lose(self, losses: list[bool]) -> None:
        """Decide which of the next requests are lost."""
        self.losses += losses

    @precondition(lambda self: self.replies)
    @rule(data=st.data(), times=st.sampled_from([0, 1, 1, 1, 2]))
    def deliver(self, data: st.DataObject, times: int) -> None:
        """Deliver a reply, or lose it; one of a request sent once perhaps twice."""
        chosen = data.draw(st.integers(0, len(self.replies) - 1))
        frame, request = self.replies.pop(chosen)
        is_sent_once = request in self.running and request.sends == 1
        for _ in range(times if is_sent_once else min(times, 1)):
            self.core.receive_frame(frame, self.now_ns)
        self.go_on()

    @rule(part=st.sampled_from([0.01, 0.3, 1.0, 1.0]))
    def wait(self, part: float) -> None:
        """Let time pass, at most until something is due."""
        due_ns = self.core.next_timeout()
        if due_ns is None:
            return
        self.now_ns += max(0, round((due_ns - self.now_ns) * part))
        self.core.handle_timeout(self.now_ns)
        self.go_on()

    @precondition(lambda self: self.running)
    @rule(data=st.data())
    def cancel(self, data: st.DataObject) -> None:
        chosen = data.draw(st.integers(0, len(self.running) - 1))
        request = list(self.running)[chosen]
        run = self.running.pop(request)
        run.conversation.close()
        self.core.close(run.place, self.now_ns)
        self.go_on()

    @invariant()
    def ended_once_and_with_its_own_data(self) -> None:
        while self.ended:
            self.ended.pop().check()

    @invariant()
    def requests_end_or_are_due(self) -> None:
        assert not any(request.is_done for request in self.running)
        assert not self.running or self.core.next_timeout() is not None

    def teardown(self) -> None:
        """Without any more losses or replies everything ends, in bounded time."""
        for _ in range(500):
            if not self.running:
                break
            self.wait(1.0)
        assert not self.running
        self.ended_once_and_with_its_own_data()

    def step(self, run: Run, step: Any) -> None:
        try:
            ask = step()
        except StopIteration as end:
            run.result = end.value
        except (EapError, BusError) as exc:
            run.error = exc
        else:
            request = self.core.request(run.place, ask, self.now_ns)
            self.running[request] = run
            self.go_on()
            return
        run.ends += 1
        self.ended.append(run)
        self.core.close(run.place, self.now_ns)
        self.go_on()

    def go_on(self) -> None:
        """Carry frames to the gateway, and results to their conversations."""
        for frame in self.core.frames_to_send(self.now_ns):
            request = next((each for each in self.running if each.frame is frame), None)
            self.sent_ns[request] = self.now_ns
            if request is not None and (run := self.running[request]).executions is None:
                run.executions = run.slave.executions
            if not (self.losses.pop() if self.losses else False):
                self.execute(frame, request)
        limit_ns = self.now_ns - TIMEOUT_NS
        self.replies = [each for each in self.replies if self.sent_ns[each[1]] > limit_ns]
        while (request := self.core.next_event()) is not None:
            run = self.running.pop(request, None)
            if run is None:
                continue  # cancelled
            try:
                message = request.result()
            except BusError as exc:
                self.step(run, lambda run=run, exc=exc: run.conversation.throw(exc))
            else:
                self.step(run, lambda run=run, message=message: run.conversation.send(message))

    def execute(self, frame: bytes, request: PendingRequest | None) -> None:
        header, body = decode_frame(frame)
        done = self.slaves[header.address].execute(header.type, bytes(body), header.counter)
        if done is not None:
            reply = encode_frame(MailboxHeader(0, header.address, type=done[0]), done[1])
            self.replies.append((reply, request))


TestConversationsMachine = ConversationsMachine.TestCase
TestConversationsMachine.settings = settings(max_examples=60)
