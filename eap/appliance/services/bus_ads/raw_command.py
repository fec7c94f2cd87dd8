"""EtherCAT commands that clients send to a bus by ADS, as AdsLib does (its ECatAccess.cpp).

Each is a datagram with its header and its working counter, there and back; several follow each
other.  The engine takes those that do not disturb the exchange of process data.
"""

from __future__ import annotations

from devicebus.master.access import Access, Reply, brd
from devicebus.wire.datagram import Command, DatagramHeader, WorkingCounter
from eap.aoe.ads_operation import AdsRefusedError
from eap.codec.ads import AdsError
from eap.errors import MalformedError, TruncatedError

_TRIES = 1
"""Whoever reads and writes by himself wants each command sent once."""
_COUNTING = frozenset((Command.APRD, Command.APWR, Command.APRW, Command.BRD))
"""Every slave adds one to the address of these."""


class RawCommands:
    """The commands of one request; *data* is what it writes.

    Raises:
        AdsRefusedError: SIZE, it ends too early, or VALUE, nobody knows a command.
    """

    def __init__(self, data: bytes) -> None:
        self._heads: list[DatagramHeader] = []
        self._octets: list[bytes] = []
        at = 0
        try:
            while at < len(data):
                head = DatagramHeader.decode(data, at)
                start = at + DatagramHeader.SIZE
                at = start + head.length + WorkingCounter.SIZE
                if at > len(data):
                    raise AdsRefusedError(AdsError.SIZE, "a command without a working counter")
                self._heads.append(head)
                self._octets.append(data[start : start + head.length])
        except TruncatedError as exc:
            raise AdsRefusedError(AdsError.SIZE, str(exc)) from None
        except MalformedError as exc:
            raise AdsRefusedError(AdsError.VALUE, str(exc)) from None
        if not self._heads:
            raise AdsRefusedError(AdsError.SIZE, "no command")

    def accesses(self) -> list[Access]:
        """Return what is to be sent, and one more access that tells how many slaves there are."""
        return [
            brd(0, 1),
            *(
                Access(Command(head.command), head.adp, head.ado, octets, _TRIES)
                for head, octets in zip(self._heads, self._octets, strict=True)
            ),
        ]

    def encode_answer(self, replies: list[Reply]) -> bytes:
        """Return what came back, from the replies to :meth:`accesses`."""
        slaves = replies[0].wkc
        return b"".join(
            _passed(head, slaves).encode() + reply.data + WorkingCounter(reply.wkc).encode()
            for head, reply in zip(self._heads, replies[1:], strict=True)
        )


def _passed(head: DatagramHeader, slaves: int) -> DatagramHeader:
    """Return the header as it is behind all slaves."""
    adp = head.adp + slaves if head.command in _COUNTING else head.adp
    return DatagramHeader(
        head.command, head.index, adp & 0xFFFF, head.ado, head.length, more=head.more
    )
