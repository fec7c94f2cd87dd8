"""One RxPD at run time: what fits it, and when its data is too old."""

from __future__ import annotations

from eap.pd.account import Account
from eap.pd.address import source_octets
from eap.pd.layout import RxPlace
from eap.pd.poll import Answer, Question
from eap.pd.spec import RxPdSpec
from eap.pd.substitute import SubstituteValue
from eap.pd.words import Discard


class Subscription:
    """One RxPD at run time.

    Args:
        spec: What is expected.
        place: Where it goes.
        substitute: What its variables hold after the time-out.
        question: What asks for it; None if it comes by itself.

    Attributes:
        account: Where its arrivals are entered; the subscriber opens it.
        alternates: What copies another layout that is taken as well, by version and length.
        answer: What it is to its question; None if it comes by itself.
        source: The address that its frames must come from; empty for any.
    """

    __slots__ = (
        "account",
        "alternates",
        "answer",
        "ignore_version",
        "place",
        "source",
        "substitute",
        "timeout_ns",
    )

    def __init__(
        self,
        spec: RxPdSpec,
        place: RxPlace,
        substitute: SubstituteValue,
        question: Question | None = None,
    ) -> None:
        self.place = place
        self.answer = None if question is None else Answer(spec.name, question, place.words)
        self.alternates = {(each.version, each.size): each.copy_plan() for each in place.alternates}
        self.ignore_version = spec.ignore_version
        self.timeout_ns = spec.timeout_ms * 1_000_000
        self.substitute = substitute
        self.source = source_octets(spec.source) if spec.source else b""
        self.account: Account

    def mismatch(self, version: int, length: int, source: bytes) -> Discard | None:
        """Return why such a PD from the address *source* does not fit, None if it does."""
        if self.source and source != self.source:
            return Discard.WRONG_SOURCE
        if (version, length) in self.alternates:
            return None
        if version != self.place.version and not self.ignore_version:
            return Discard.VERSION
        if length != self.place.size:
            return Discard.LENGTH
        return None

    def deadline_ns(self) -> int | None:
        """Return when its data is too old, None while that cannot be: nobody asked again."""
        since_ns: int | None = self.account.arrived_at_ns
        if self.answer is not None:
            since_ns = self.answer.question.waiting_since(self.answer.name)
        return None if since_ns is None else since_ns + self.timeout_ns
