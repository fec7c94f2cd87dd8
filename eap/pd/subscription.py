"""One RxPD at run time: what fits it, when its data is too old, and what replaces it then."""

from __future__ import annotations

from eap.codec import datatypes
from eap.codec.pd import PdHeader
from eap.pd.address import source_octets
from eap.pd.image import Image, default_value, put
from eap.pd.layout import RxSlot
from eap.pd.poll import PollAnswer, PollQuestion
from eap.pd.sequence import SequenceTracker
from eap.pd.spec import RxPdSpec, Substitute
from eap.pd.words import Discard


class RxSubscription:
    """One RxPD at run time.

    Args:
        spec: What is expected.
        slot: Where it goes.
        substitute: What its variables hold after the time-out.
        question: What asks for it; None if it comes by itself.

    Attributes:
        tracker: Where its arrivals are entered; the subscriber opens it.
        alternates: What copies another layout that is taken as well, by version and length.
        answer: What it is to its question; None if it comes by itself.
        source: The address that its frames must come from; empty for any.
    """

    __slots__ = (
        "alternates",
        "answer",
        "ignore_version",
        "slot",
        "source",
        "substitute",
        "timeout_ns",
        "tracker",
    )

    def __init__(
        self,
        spec: RxPdSpec,
        slot: RxSlot,
        substitute: SubstituteValue,
        question: PollQuestion | None = None,
    ) -> None:
        self.slot = slot
        self.answer = None if question is None else PollAnswer(spec.name, question, slot.words)
        self.alternates = {(each.version, each.size): each.copy_plan() for each in slot.alternates}
        self.ignore_version = spec.ignore_version
        self.timeout_ns = spec.timeout_ms * 1_000_000
        self.substitute = substitute
        self.source = source_octets(spec.source) if spec.source else b""
        self.tracker: SequenceTracker

    def mismatch(self, version: int, length: int, source: bytes) -> Discard | None:
        """Return why such a PD from the address *source* does not fit, None if it does."""
        if self.source and source != self.source:
            return Discard.WRONG_SOURCE
        if (version, length) in self.alternates:
            return None
        if version != self.slot.version and not self.ignore_version:
            return Discard.VERSION
        if length != self.slot.size:
            return Discard.LENGTH
        return None

    def deadline_ns(self) -> int | None:
        """Return when its data is too old, None as long as it was not requested again."""
        since_ns: int | None = self.tracker.arrived_at_ns
        if self.answer is not None:
            since_ns = self.answer.question.waiting_since(self.answer.name)
        return None if since_ns is None else since_ns + self.timeout_ns


class SubstituteValue:
    """The octets that replace a PD's data after its time-out; with HOLD there are none."""

    def __init__(self, image: Image, slot: RxSlot) -> None:
        start = slot.offset + PdHeader.SIZE
        self._memory = image.memory
        self._data = slice(start, start + slot.size)
        self._octets = _octets(image, slot)

    def apply(self) -> None:
        """Put the substitute in the place of the data."""
        if self._octets is not None:
            self._memory[self._data] = self._octets


def _octets(image: Image, slot: RxSlot) -> bytes | None:
    if slot.substitute is Substitute.HOLD:
        return None
    if slot.substitute is Substitute.ZERO:
        return bytes(slot.size)
    octets = memoryview(bytearray(slot.size))
    start = 8 * (slot.offset + PdHeader.SIZE)
    for name in slot.variables:
        variable = image.slots[name]
        kind = datatypes.parse(variable.type)
        value = kind.encode(default_value(variable))
        put(octets, variable.bit_offset - start, kind.bit_length, value)
    return bytes(octets)
