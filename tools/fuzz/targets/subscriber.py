"""Frames as a station's port takes them: no exception at all, and nothing uncounted."""

from __future__ import annotations

from eap.ids import InterfaceUri, NetId
from eap.pd.image import format_image
from eap.pd.layout import plan_layout
from eap.pd.poll import REQUESTERS_PER_CYCLE, PollRequests, outgoing_polls
from eap.pd.spec import (
    PortKind,
    PortSpec,
    RxAlternateSpec,
    RxPdSpec,
    SentVariableSpec,
    StationSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Writer,
)
from eap.pd.subscriber import Subscriber
from eap.pd.words import PD_DROP_REASONS, FrameWord, RxWord, StationWord

_SIZES = {1: 1, 2: 2, 0x03E9: 1, 0x1234: 4}
"""PDs to subscribe to, those of the golden vectors among them, and their octets."""
_REQUEST, _ANSWER = 1, 2
"""PD ids of a poll request and of its answer."""
_CYCLE_INPUTS = 40
"""Inputs between two cycles."""


def _shifted(name: str, size: int) -> tuple[RxAlternateSpec, ...]:
    """The same variable behind three bits, in another version and, told by the length, in this."""
    variables = SentVariableSpec("", "BIT3"), SentVariableSpec(name, f"BLOCK({size})")
    return RxAlternateSpec(0, variables), RxAlternateSpec(1, variables)


def _block(name: str, pd_id: int, size: int) -> RxPdSpec:
    asked_by = "question" if pd_id == _ANSWER else ""
    return RxPdSpec(
        name,
        "eap0",
        pd_id,
        (name,),
        sender_cycle_us=1000,
        step=0 if asked_by else 1,
        poll_request=asked_by,
        alternates=_shifted(name, size),
    )


_LIES_OTHERWISE = (
    SentVariableSpec("", "BIT3"),
    SentVariableSpec("level", "BIT8"),
    SentVariableSpec("on", "BOOL"),
)
_SPEC = StationSpec(
    "fuzzed",
    NetId.parse("5.1.1.1.1.1"),
    1000,
    (
        PortSpec(
            "eap0", PortKind.EAP, InterfaceUri.parse("loop://line"), NetId.parse("5.1.1.1.2.1")
        ),
    ),
    variables=(
        *(VariableSpec(f"v{n}", f"BLOCK({size})", Writer.ENGINE) for n, size in _SIZES.items()),
        VariableSpec("on", "BOOL", Writer.ENGINE),
        VariableSpec("level", "BIT8", Writer.ENGINE),
        VariableSpec("x", "UINT"),
    ),
    frames=(TxFrameSpec("ask", "eap0", "10.0.0.1", (TxPdSpec("question", 9, ("x",)),)),),
    subscriptions=(
        *(_block(f"v{pd_id}", pd_id, size) for pd_id, size in _SIZES.items()),
        RxPdSpec(
            "bits", "eap0", 3, ("on", "level"), alternates=(RxAlternateSpec(1, _LIES_OTHERWISE),)
        ),
    ),
)
_LAYOUT = plan_layout(_SPEC)
_IMAGE = format_image(memoryview(bytearray(_LAYOUT.size)), _LAYOUT, 1)
_DIRECTORY = bytes(_IMAGE.memory[_LAYOUT.directory_offset :])
_REQUESTS = PollRequests([f"v{_REQUEST}"])
_QUESTIONS = outgoing_polls(_IMAGE)
_SUBSCRIBERS = [
    Subscriber(
        _IMAGE,
        zip(_SPEC.subscriptions, _LAYOUT.rx, strict=True),
        1_000_000,
        _REQUESTS,
        _QUESTIONS,
        lenient=lenient,
    )
    for lenient in (False, True)
]
for _subscriber in _SUBSCRIBERS:
    _subscriber.open(0)


class _Anybody:
    """The sender of a frame: any of 256, as its last octet says, the first of them without name."""

    def source_of(self, data: memoryview) -> bytes:
        """Return one of four addresses."""
        return bytes((10, 0, 0, data[len(data) - 17] & 3))

    def sender_of(self, data: memoryview) -> str:
        """Return a destination for answers."""
        number = data[len(data) - 17]
        return f"10.0.0.{number}" if number else ""


def fuzz_one(data: bytes) -> None:
    """Take the frame at a time that its own octets give."""
    before = _counted()
    at_ns = len(data) * 300_000
    subscriber = _SUBSCRIBERS[len(data) & 1]
    subscriber.receive_frame(memoryview(data + bytes(16)), len(data), at_ns, _Anybody())
    _run_cycle(at_ns)
    if _IMAGE.memory[_LAYOUT.directory_offset :] != _DIRECTORY:
        raise AssertionError("what lies behind the variables was overwritten")
    if _IMAGE.words[StationWord.ENGINE_SEQUENCE] % 2:
        raise AssertionError("the engine's region stayed marked as changing")
    carries_none = len(data) >= 14 and data[8:10] == b"\0\0"
    if _counted() == before and not carries_none:
        raise AssertionError("neither taken nor counted")


def _run_cycle(now_ns: int) -> None:
    """Now and then take the requests, and ask."""
    words = _IMAGE.words
    words[StationWord.CYCLE] += 1
    if words[StationWord.CYCLE] % _CYCLE_INPUTS:
        return
    if len(_REQUESTS.pop_all()) > REQUESTERS_PER_CYCLE:
        raise AssertionError("more requests were noted than are answered")
    words[_LAYOUT.frames[0].words + FrameWord.WHOLE] += 1
    for question in _QUESTIONS.values():
        question.look(now_ns)
    for place in _LAYOUT.rx:
        if words[place.words + RxWord.RESPONSE_NS] < 0:
            raise AssertionError("an answer came before its request")


def _counted() -> int:
    words = _IMAGE.words
    total = sum(words[StationWord.DISCARDED : StationWord.DISCARDED + len(PD_DROP_REASONS)])
    for place in _LAYOUT.rx:
        first = words[place.words + RxWord.TRACKER]
        total += words[first + RxWord.RECEIVED] + words[first + RxWord.REORDERED]
    return total
