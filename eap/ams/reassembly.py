"""Fragments that come from many sides, put together in bounded memory."""

from __future__ import annotations

from collections import OrderedDict

from eap.ads.endpoint import Endpoint
from eap.ams.fragment import Assembler, Taken
from eap.codec.ams import AmsHeader
from eap.errors import MalformedError

MAX_SENDERS = 64
"""Ways that fragments are kept of at a time; the one that began first makes room."""
MAX_OCTETS = 16 << 20
"""Octets kept in all; the sender whose fragment is too much loses what it has sent."""


class Reassembly:
    """An assembler for each way.

    Nobody's fragments fit to those of another, and nobody can push out more than their own as
    long as fewer than 64 send.

    Attributes:
        dropped: Packets that were not put together.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._senders: OrderedDict[Endpoint, Assembler] = OrderedDict()
        self._octets = 0

    @property
    def octets(self) -> int:
        """Octets that are kept."""
        return self._octets

    def receive(self, endpoint: Endpoint, header: AmsHeader, body: bytes, now_ns: int) -> Taken:
        """Take a fragment that came by *endpoint*.

        Raises:
            MalformedError: it does not fit to the one before it, the whole is too long, or too
                much is kept already.
        """
        assembler = self._of(endpoint, now_ns)
        before = assembler.octets, assembler.dropped
        try:
            taken = assembler.receive(header, body, now_ns)
        finally:
            self._account(endpoint, assembler, before)
        if self._octets > MAX_OCTETS:
            self._drop(endpoint)
            raise MalformedError(
                f"{MAX_OCTETS} octets of fragments are kept already", layout="AmsHeader"
            )
        return taken

    def forget(self, endpoint: Endpoint) -> None:
        """Forget what came by *endpoint*."""
        assembler = self._senders.pop(endpoint, None)
        if assembler is not None:
            self._octets -= assembler.octets

    def _of(self, endpoint: Endpoint, now_ns: int) -> Assembler:
        assembler = self._senders.get(endpoint)
        if assembler is not None:
            return assembler
        if len(self._senders) >= MAX_SENDERS:
            self._expire(now_ns)
        if len(self._senders) >= MAX_SENDERS:
            self._drop(next(iter(self._senders)))
        assembler = self._senders[endpoint] = Assembler()
        return assembler

    def _expire(self, now_ns: int) -> None:
        for endpoint, assembler in list(self._senders.items()):
            before = assembler.octets, assembler.dropped
            assembler.expire(now_ns)
            self._account(endpoint, assembler, before)

    def _account(self, endpoint: Endpoint, assembler: Assembler, before: tuple[int, int]) -> None:
        self._octets += assembler.octets - before[0]
        self.dropped += assembler.dropped - before[1]
        if not len(assembler):
            self.forget(endpoint)

    def _drop(self, endpoint: Endpoint) -> None:
        self.dropped += len(self._senders[endpoint])
        self.forget(endpoint)
