"""The IDNs of a drive behind an index group, by SoE (Ads.h of the TwinCAT SDK; ETG.1000.6).

Several elements come one behind the other, lists and texts with their heads, as the drive sends
them.  A procedure command is started, watched and cleared here, own format: whoever asks is told
BUSY while it takes longer than an answer may, and asks again.
"""

from __future__ import annotations

import asyncio
from collections.abc import Collection

from devicebus.errors import MailboxTimeoutError, SoeError
from devicebus.mailbox import soe_client
from devicebus.mailbox.soe_procedure import CLEAR, START
from devicebus.wire.sii import SiiProtocol
from eap.aoe.ads_operation import AdsRefusedError
from eap.appliance.handover import PortName
from eap.appliance.services.bus.bus_client import BusClient
from eap.appliance.services.bus_ads.slave_space import Asked, SlaveSpace
from eap.codec.ads import AdsError, IndexGroup, SoePlace
from eap.codec.soe import DataState, Element, Idn
from eap.codec.soeerror import SoeErrorCode

ANSWER_S = 3.0
"""How long one request waits for a procedure command to end."""
EXECUTION_S = 60.0
"""How long a procedure command may take."""
KEEP_S = 30.0
"""How long is known how a procedure command ended, for whoever asks again."""
MAX_COMMANDS = 64
"""Procedure commands that go on or are known at a time, of all drives."""
_POLL_S = 0.02
_START = START.to_bytes(2, "little")
_CLEAR = CLEAR.to_bytes(2, "little")

_Place = tuple[int, int, int]


class SlaveIdns(SlaveSpace):
    """Elements of IDNs, and procedure commands."""

    groups: Collection[int] = frozenset((IndexGroup.SOE,))
    protocol = SiiProtocol.SOE

    def __init__(self, bus: BusClient, port: PortName) -> None:
        super().__init__(bus, port)
        self._commands: dict[_Place, asyncio.Task[None]] = {}

    async def read(self, asked: Asked, group: int, offset: int, length: int) -> bytes:
        """Return elements; of a command its data state, whichever are named."""
        del group, length
        place = _place(offset)
        elements = Element.DATA_STATE if place.is_command else place.elements
        return await self._read(asked, place, elements)

    async def write(self, asked: Asked, group: int, offset: int, data: bytes) -> None:
        """Write an element, or execute a procedure command."""
        del group
        place = _place(offset)
        if place.is_command:
            if data not in (b"", _START):
                raise AdsRefusedError(AdsError.VALUE, "a command is started by 3, or by no data")
            await self._execute(asked, place)
            return
        await self._write(asked, place, data, place.elements)

    async def _execute(self, asked: Asked, place: SoePlace) -> None:
        key = asked.slave.station, place.drive, place.idn
        task = self._commands.get(key)
        if task is None:
            if len(self._commands) >= MAX_COMMANDS:
                raise AdsRefusedError(AdsError.NO_MEMORY, f"{MAX_COMMANDS} commands go on already")
            task = asyncio.get_running_loop().create_task(self._lead(asked, place))
            self._commands[key] = task
            task.add_done_callback(lambda task: self._forget_later(key, task))
        await asyncio.wait({task}, timeout=ANSWER_S)
        if not task.done():
            idn = Idn.of(place.idn)
            raise AdsRefusedError(AdsError.BUSY, f"{idn} is being executed: ask again")
        self._forget(key, task)
        task.result()

    async def _lead(self, asked: Asked, place: SoePlace) -> None:
        """Execute a command; others talk to the drive meanwhile."""
        what = f"procedure command {Idn.of(place.idn)} at drive {place.drive}"
        await self._write(asked, place, _START, Element.VALUE)
        end_s = asyncio.get_running_loop().time() + EXECUTION_S
        state = DataState.BUSY
        while state & DataState.EXECUTING and not state & DataState.ERROR:
            if asyncio.get_running_loop().time() > end_s:
                break
            await asyncio.sleep(_POLL_S)
            octets = await self._read(asked, place, Element.DATA_STATE)
            state = DataState(int.from_bytes(octets[:2], "little") & DataState.FAILED)
        await self._write(asked, place, _CLEAR, Element.VALUE)
        if state & DataState.ERROR:
            raise SoeError(f"{what}: failed", code=SoeErrorCode.GENERAL)
        if state & DataState.EXECUTING:
            raise MailboxTimeoutError(f"{what}: not done after {EXECUTION_S:g} s")

    async def _read(self, asked: Asked, place: SoePlace, elements: int) -> bytes:
        idn = Idn.of(place.idn)
        return await self.converse(asked, soe_client.read(idn, elements, drive=place.drive))

    async def _write(self, asked: Asked, place: SoePlace, data: bytes, elements: int) -> None:
        idn, sizes = Idn.of(place.idn), asked.sizes
        await self.converse(
            asked, soe_client.write(idn, data, sizes, elements=elements, drive=place.drive)
        )

    def _forget_later(self, key: _Place, task: asyncio.Task[None]) -> None:
        if not task.cancelled():
            task.exception()  # it may be that nobody asks again
            asyncio.get_running_loop().call_later(KEEP_S, self._forget, key, task)

    def _forget(self, key: _Place, task: asyncio.Task[None]) -> None:
        if self._commands.get(key) is task:
            del self._commands[key]


def _place(offset: int) -> SoePlace:
    place = SoePlace.decode(offset.to_bytes(4, "little"))
    if place.reserved:
        raise AdsRefusedError(AdsError.INDEX_OFFSET)
    return place
