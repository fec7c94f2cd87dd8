"""The way to one slave, or master, of another station: requests by AoE through the own router."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeAlias

from eap.aoe.ads_operation import Operation, Read
from eap.aoe.ads_query import decode_outcome, encode_query
from eap.aoe.answer import AmsAnswer
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.ams import DEVICE_PORT
from eap.gateway.address import RemoteSlave
from eap.gateway.elsewhere import ElsewhereError, reason_for, sdo_offset

_ADDRESSES, _SLAVES = 0xF020, 0x8000
_TO_SLAVE, _TO_MASTER = 33, 34
_LISTS, _LISTED = 16, 255
"""Objects from 0xF020 on, and addresses in each."""


class Ask(Protocol):
    """Asks somebody behind the NetID of a bus; every failure is an error of the answer."""

    async def __call__(
        self, port: int, command: int, body: bytes, *, timeout_s: float
    ) -> AmsAnswer:
        """Return the answer."""


class RemoteLink:
    """Asks one slave.

    Args:
        ask: As above.
        port: AMS port of the slave; 0xFFFF is the master.
        answer_s: How long an answer may take.
    """

    def __init__(self, ask: Ask, port: int, answer_s: float) -> None:
        self.answer_s = answer_s
        self._ask = ask
        self._port = port

    async def pass_on(self, command: int, body: bytes) -> AmsAnswer:
        """Return the answer to any request."""
        return await self._ask(self._port, command, body, timeout_s=self.answer_s)

    async def perform(
        self, operation: Operation, *, port: int | None = None, timeout_s: float | None = None
    ) -> bytes:
        """Have an operation done; return what was read.

        Args:
            operation: What is to be done.
            port: Of somebody else there.
            timeout_s: How long it may take, if not as long as an answer.

        Raises:
            ElsewhereError: it was not done.
        """
        command, body = encode_query(operation)
        answer = await self._ask(
            self._port if port is None else port, command, body,
            timeout_s=timeout_s or self.answer_s,
        )  # fmt: skip
        outcome = decode_outcome(command, answer.error_code, answer.data)
        if outcome.result:
            raise ElsewhereError(outcome.result)
        return outcome.data

    async def mailboxes(self) -> tuple[int, int]:
        """Return the octets that the slave takes and gives in one message (ETG.1510).

        Raises:
            ElsewhereError: its master does not tell.
        """
        if self._port == DEVICE_PORT:
            raise ElsewhereError(AdsError.SERVICE)  # a master has none
        try:
            index = _SLAVES + await self._number()
            return await self._word(index, _TO_SLAVE), await self._word(index, _TO_MASTER)
        except ElsewhereError as exc:
            if reason_for(exc.result) is None:  # of the dictionary, not of what is asked here
                raise ElsewhereError(AdsError.SERVICE) from None
            raise

    async def _number(self) -> int:
        """Return the number of the slave in the lists of its master."""
        for number in range(_LISTS):
            offset = sdo_offset(_ADDRESSES + number, 0, complete=True)
            listed = await self.perform(
                Read(IndexGroup.SDO, offset, 2 + 2 * _LISTED), port=DEVICE_PORT
            )
            places = range(2, min(len(listed) - 1, 2 + 2 * _LISTED), 2)
            stations = [int.from_bytes(listed[at : at + 2], "little") for at in places]
            if self._port in stations:
                return number * _LISTED + stations.index(self._port)
            if len(stations) < _LISTED:
                break
        raise ElsewhereError(AdsError.TARGET_PORT)

    async def _word(self, index: int, subindex: int) -> int:
        offset = sdo_offset(index, subindex, complete=False)
        read = Read(IndexGroup.SDO, offset, 2)
        return int.from_bytes(await self.perform(read, port=DEVICE_PORT), "little")


LinkTo: TypeAlias = Callable[[RemoteSlave], RemoteLink]
"""Returns the way to somebody elsewhere."""
