"""Pending requests of one gateway client: frames in, frames out, one result for each request.

Rule 1: a reply belongs to a request by address, protocol and content, never by its counter: a
gateway passes on the counter of the slave, which numbers its own messages (ETG.1000.4).
Rule 2: one conversation at a time per address and protocol, in order of arrival: segments and
packets name neither object nor file, and a gateway has one session for each slave and protocol.
Rule 3: a request that was sent more than once may be answered more than once.  The next request
that such a reply would fit waits until the reply has come, or its time is over.
Rule 4: a mailbox error names no protocol.  Where several requests wait at an address, it counts for
none of them, and each that has no reply is sent again with nothing else pending there.
"""

from __future__ import annotations

from collections import deque

from devicebus.errors import BusError, MailboxRefusedError, MailboxTimeoutError
from devicebus.mailbox.conversation import (
    ABORT_MESSAGES,
    MailboxMessage,
    MailboxRequest,
    answers,
    has_more,
    next_counter,
)
from eap.codec.mailbox import (
    MailboxError,
    MailboxErrorReply,
    MailboxType,
    decode_frame,
    encode_plain_frame,
)
from eap.codec.wire import Buffer
from eap.errors import CodecError

_MAX_EARLY = 1024
"""Fragments of one reply that may come before the conversation listens for them."""
_COUNTER_OCTET, _COUNTER_SHIFT = 7, 4
"""Place of the counter in a frame: bits 4 to 6 of the mailbox header's last byte."""


class PendingRequest:
    """One request of a conversation, from the moment it is made to its result.

    Attributes:
        ask: The request as the conversation made it.
        is_done: Whether there is a result.
        is_taken: Whether the conversation has it.
    """

    __slots__ = (
        "_outcome", "ask", "deadline_ns", "first_ns", "frame", "is_done", "is_single", "is_taken",
        "sends", "tries",
    )  # fmt: skip

    def __init__(self, ask: MailboxRequest, due_ns: int, tries: int) -> None:
        self.ask = ask
        self.is_done = self.is_taken = False
        self.frame = b""
        self.sends = 0
        self.tries = tries
        self.first_ns = 0
        self.deadline_ns: int | None = due_ns
        """Time to send it, or to give up; None while it may not be sent beside another."""
        self.is_single = False
        """True if it has to be the only one in flight at its address."""
        self._outcome: MailboxMessage | BusError

    @property
    def is_in_flight(self) -> bool:
        """True if a reply to it is expected by now."""
        return self.sends > 0 and self.deadline_ns is not None and not self.is_done

    def result(self) -> MailboxMessage:
        """Return the reply to the conversation, or raise the error in its place."""
        self.is_taken = True
        if isinstance(self._outcome, BusError):
            raise self._outcome
        return self._outcome

    def finish(self, outcome: MailboxMessage | BusError) -> None:
        """Set the result."""
        self._outcome = outcome
        self.is_done = True


class GatewayConversation:
    """The place of one conversation among those with its address."""

    __slots__ = ("address", "request")

    def __init__(self, address: int) -> None:
        self.address = address
        self.request: PendingRequest | None = None


class _LateReplies:
    """Replies that may still come to a request that is over."""

    __slots__ = ("count", "reply", "request", "until_ns")

    def __init__(
        self, request: PendingRequest, reply: bytes | None, count: int, until_ns: int
    ) -> None:
        self.request = request.ask.request
        self.reply = reply
        self.count = count
        self.until_ns = until_ns


class _Queue:
    """Conversations with one address by one protocol; the first one has its turn."""

    __slots__ = ("conversations", "early", "has_more", "kind", "late")

    def __init__(self, kind: MailboxType) -> None:
        self.kind = kind
        self.conversations: deque[GatewayConversation] = deque()
        self.late: list[_LateReplies] = []
        self.early: deque[MailboxMessage] = deque(maxlen=_MAX_EARLY)
        self.has_more = False

    @property
    def pending(self) -> PendingRequest | None:
        """The request that has its turn and no result yet."""
        request = self.conversations[0].request if self.conversations else None
        is_ours = request is not None and not request.is_done and request.ask.type is self.kind
        return request if is_ours else None

    def due_ns(self) -> int | None:
        """Return when there is something to do for the pending request."""
        request = self.pending
        if request is None or request.deadline_ns is None:
            return None
        if request.sends or not self.late or not request.ask.expects_reply:
            return request.deadline_ns
        held = [late.until_ns for late in self.late if self._fits(late, request.ask)]
        return max(request.deadline_ns, *held) if held else request.deadline_ns

    def _fits(self, late: _LateReplies, ask: MailboxRequest) -> bool:
        """Return whether a late reply could be mistaken for the one to *ask*."""
        return late.reply is None or answers(self.kind, ask.request, late.reply)

    def count_off_late(self, data: bytes) -> None:
        """Expect one late reply less, if *data* is one."""
        for late in self.late:
            if answers(self.kind, late.request, data):
                if not has_more(self.kind, data):
                    self.count_off(late)
                return

    def count_off(self, late: _LateReplies) -> None:
        """Expect one of these replies less."""
        late.count -= 1
        if not late.count:
            self.late.remove(late)


class _Address:
    """Everything that is pending at one address."""

    __slots__ = ("number", "queues")

    def __init__(self, number: int) -> None:
        self.number = number
        self.queues: dict[MailboxType, _Queue] = {}

    def pending(self) -> list[tuple[_Queue, PendingRequest]]:
        """Return the requests that have their turn."""
        queues = self.queues.values()
        return [(queue, found) for queue in queues if (found := queue.pending) is not None]

    def is_free_for(self, request: PendingRequest) -> bool:
        """Return whether a request may be sent in parallel to those in flight."""
        if len(self.queues) == 1:
            return True
        others = [other for _, other in self.pending() if other is not request]
        if request.is_single:
            return not any(other.is_in_flight for other in others)
        return not any(other.is_single for other in others)


class GatewayConversations:
    """All conversations of one client of a gateway.

    Args:
        timeout_ns: Time for a reply, before the request is sent again.
        tries: Number of times that a request is sent.
        silence: Text of the error when no reply has come.

    Attributes:
        timeout_ns: As above, for requests from now on.
        tries: As above, for requests from now on.
        silence: As above.
    """

    def __init__(self, *, timeout_ns: int, tries: int, silence: str) -> None:
        self.timeout_ns = timeout_ns
        self.tries = tries
        self.silence = silence
        self._addresses: dict[int, _Address] = {}
        self._counters: dict[int, int] = {}
        self._frames: list[bytes] = []
        self._events: deque[PendingRequest] = deque()

    def request(
        self, conversation: GatewayConversation, ask: MailboxRequest, now_ns: int
    ) -> PendingRequest:
        """Make the next request of a conversation; it is sent when its turn comes.

        Raises:
            CodecError: it is too long for a frame.
        """
        request = PendingRequest(ask, now_ns + ask.delay_ns, self.tries)
        request.frame = encode_plain_frame(ask.type, conversation.address, 0, ask.request)
        conversation.request = request
        number = conversation.address
        address = self._addresses.setdefault(number, _Address(number))
        queue = address.queues.setdefault(ask.type, _Queue(ask.type))
        if conversation not in queue.conversations:
            queue.conversations.append(conversation)
        self._advance(address, now_ns)
        return request

    def close(self, conversation: GatewayConversation, now_ns: int) -> None:
        """End a conversation, and let the next one have its turn.

        One that is broken off tells the slave, which may otherwise keep a transfer open.
        """
        address = self._addresses.get(conversation.address)
        request, conversation.request = conversation.request, None
        if address is None or request is None:
            return
        was_sent = request.sends > 0
        for queue in address.queues.values():
            if conversation not in queue.conversations:
                continue
            if queue.conversations[0] is conversation:
                queue.early.clear()
                queue.has_more = False
            if was_sent and not request.is_done and request.ask.type is queue.kind:
                until_ns = now_ns + self.timeout_ns
                queue.late.append(_LateReplies(request, None, request.sends, until_ns))
            queue.conversations.remove(conversation)
        # Slaves handle one SDO or file at a time (ETG.1000.6): an abandoned one would block them.
        if was_sent and not request.is_taken and request.ask.type in ABORT_MESSAGES:
            abort = ABORT_MESSAGES[request.ask.type]
            frame = encode_plain_frame(abort.type, address.number, 0, abort.request)
            self._frames.append(self._numbered(address.number, frame))
        self._advance(address, now_ns)
        for queue in list(address.queues.values()):
            if not queue.conversations and not queue.late:
                del address.queues[queue.kind]
        if not address.queues:
            del self._addresses[address.number]

    def receive_frame(self, octets: Buffer, now_ns: int) -> None:
        """Handle a received frame; a frame that answers no request is dropped."""
        try:
            header, body = decode_frame(octets)
        except CodecError:
            return
        address = self._addresses.get(header.address)
        if address is None:
            return
        data = bytes(body)
        if header.type is MailboxType.ERR:
            self._receive_error(address, data, now_ns)
        elif (queue := address.queues.get(header.type)) is not None:
            self._receive(
                address, queue, MailboxMessage(header.type, data, counter=header.counter), now_ns
            )
        self._advance(address, now_ns)

    def frames_to_send(self, now_ns: int) -> list[bytes]:
        """Take the frames that are ready to go out."""
        del now_ns
        frames, self._frames = self._frames, []
        return frames

    def next_timeout(self) -> int | None:
        """Return when :meth:`handle_timeout` must be called."""
        queues = (
            queue for address in self._addresses.values() for queue in address.queues.values()
        )
        return min((due for queue in queues if (due := queue.due_ns()) is not None), default=None)

    def handle_timeout(self, now_ns: int) -> None:
        """Send or repeat the requests that are due; time out those without tries left."""
        for address in list(self._addresses.values()):
            self._advance(address, now_ns)

    def next_event(self) -> PendingRequest | None:
        """Return the next request that has a result."""
        return self._events.popleft() if self._events else None

    def _receive(
        self, address: _Address, queue: _Queue, message: MailboxMessage, now_ns: int
    ) -> None:
        request = queue.pending
        if (
            request is not None
            and request.sends
            and answers(queue.kind, request.ask.request, message.data)
        ):
            self._finish(queue, request, message, now_ns)
            self._resend_last_single(address, now_ns)
        elif queue.has_more:
            queue.early.append(message)
            queue.has_more = has_more(queue.kind, message.data)
        else:
            queue.count_off_late(message.data)

    def _receive_error(self, address: _Address, data: bytes, now_ns: int) -> None:
        for queue in address.queues.values():
            for late in queue.late:
                if late.reply is None:
                    queue.count_off(late)
                    return
        refused = [(queue, request) for queue, request in address.pending() if request.is_in_flight]
        if len(refused) == 1:
            queue, request = refused[0]
            self._finish(queue, request, _refusal(address.number, data), now_ns)
            return
        for _, request in refused:
            if not request.is_single and not request.ask.listen:
                request.is_single = True
                request.tries += 1

    def _resend_last_single(self, address: _Address, now_ns: int) -> None:
        """Send the one request again, without delay, that a mailbox error has to belong to."""
        if len(address.queues) == 1:
            return
        # A mailbox error names no protocol; with one request left it can only belong to that.
        left = [request for _, request in address.pending() if request.is_in_flight]
        if len(left) == 1 and left[0].is_single:
            left[0].deadline_ns = now_ns

    def _advance(self, address: _Address, now_ns: int) -> None:
        """Do whatever is due at an address, until nothing is."""
        is_changed = True
        while is_changed:
            is_changed = False
            for queue in address.queues.values():
                if self._advance_queue(address, queue, now_ns) and len(address.queues) > 1:
                    is_changed = True

    def _advance_queue(self, address: _Address, queue: _Queue, now_ns: int) -> bool:
        """Do the next step for the pending request; return whether others may go on after it."""
        if queue.late:
            queue.late = [late for late in queue.late if late.until_ns > now_ns]
        request = queue.pending
        if request is None:
            return False
        # A fragment is awaited without a request, so it cannot be requested again either.
        if request.ask.listen and not request.sends:
            request.sends = request.tries = 1
            request.deadline_ns = now_ns + self.timeout_ns * self.tries
            return self._take_early(queue, request, now_ns)
        due_ns = queue.due_ns()
        if due_ns is not None and now_ns < due_ns:
            return False
        if request.sends >= request.tries:
            silence = f"no answer from address {address.number}: {self.silence}"
            self._finish(queue, request, MailboxTimeoutError(silence), now_ns)
            return True
        if request.ask.expects_reply and not address.is_free_for(request):
            was_in_flight, request.deadline_ns = request.is_in_flight, None
            return was_in_flight
        return self._send(address, queue, request, now_ns)

    def _send(self, address: _Address, queue: _Queue, request: PendingRequest, now_ns: int) -> bool:
        """Send a request; return whether that was all there is to do for it."""
        if not request.sends:
            request.frame = self._numbered(address.number, request.frame)
            request.first_ns = now_ns
        request.sends += 1
        request.deadline_ns = now_ns + self.timeout_ns
        self._frames.append(request.frame)
        if request.ask.expects_reply:
            return self._take_early(queue, request, now_ns)
        request.finish(MailboxMessage(queue.kind, b""))
        self._events.append(request)
        return True

    def _numbered(self, address: int, frame: bytes) -> bytes:
        """Return a frame with the next counter of its address."""
        # Each address has its own: gateways that pass the counter on to the slave (IgH) would
        # otherwise send a slave the same one twice now and then, which it takes for a repeat.
        counter = self._counters[address] = next_counter(self._counters.get(address, 0))
        numbered = bytearray(frame)
        numbered[_COUNTER_OCTET] |= counter << _COUNTER_SHIFT
        return bytes(numbered)

    def _take_early(self, queue: _Queue, request: PendingRequest, now_ns: int) -> bool:
        """Finish a request whose reply has come already; return whether it has."""
        while queue.early:
            message = queue.early.popleft()
            if answers(queue.kind, request.ask.request, message.data):
                self._finish(queue, request, message, now_ns)
                return True
        return False

    def _finish(
        self,
        queue: _Queue,
        request: PendingRequest,
        outcome: MailboxMessage | BusError,
        now_ns: int,
    ) -> None:
        data = outcome.data if isinstance(outcome, MailboxMessage) else None
        if isinstance(outcome, MailboxTimeoutError):
            late = _LateReplies(request, None, request.sends, now_ns + self.timeout_ns)
        else:
            # Any other reply is late by as much, or by less, than this one was.
            until_ns = 2 * now_ns - request.first_ns
            late = _LateReplies(request, data, request.sends - 1, until_ns)
        if late.count:
            queue.late.append(late)
        queue.has_more = bool(queue.early) or (data is not None and has_more(queue.kind, data))
        request.finish(outcome)
        self._events.append(request)


def _refusal(address: int, data: bytes) -> MailboxRefusedError:
    name = f"slave {address}" if address else "the master"
    try:
        detail = MailboxErrorReply.decode(data).detail
    except CodecError:
        return MailboxRefusedError(f"{name}: mailbox error without a reason", detail=0)
    return MailboxRefusedError(
        f"{name}: mailbox error {MailboxError.text_of(detail)}", detail=detail
    )
