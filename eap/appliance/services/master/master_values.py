"""What the dictionary of a master shows: the bus as it was seen a moment ago.

Reading an entry cannot wait for the bus, so whoever serves the dictionary has it looked at first
(:meth:`MasterView.refresh`): the engine's report always, registers of slaves where these are asked
for.  What the bus counts and loses between two looks is not seen.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Coroutine, Sequence
from typing import Any, NamedTuple

from devicebus.errors import AlStatusError
from devicebus.master.access import fpwr
from devicebus.wire.alstatus import AlState
from eap.appliance.bus_request import BusReport, SlaveReport
from eap.appliance.handover import PortName
from eap.appliance.services.bus.bus_client import BusClient
from eap.appliance.services.master.configured_values import configured_value
from eap.appliance.services.master.master_look import (
    LOOPS,
    PORTS,
    Found,
    Seen,
    communicating,
    detect,
    look_at,
    neighbour,
)
from eap.appliance.services.master.slave_facts import SlaveFacts
from eap.errors import EapError
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.profiles.master1100 import Live

FRESH_S = 0.1
"""How long a look at the bus is good for."""
LINKS_FRESH_S = 1.0
"""How long more a look at registers is good for the configuration, which shows links only."""
_STATES = frozenset((AlState.INIT, AlState.PREOP, AlState.SAFEOP, AlState.OP, AlState.BOOT))
_AL_CONTROL_BITS = 6
"""State, acknowledgement, request for an id: what stands above them is nothing."""

logger = logging.getLogger(__name__)


class Detection(NamedTuple):
    """The last scan, as object 0xF002 tells of it."""

    status: int = 0
    slaves: int = 0


_BUSY, _DONE, _FAILED = 255, 1, 3
"""Of a command that has a response; 0 is one that has none (ETG.1000.6, type COMMAND_PAR)."""


class MasterView:
    """The master behind one bus port.

    Args:
        bus: Asks the engine.
        port: Which bus.
    """

    def __init__(self, bus: BusClient, port: PortName) -> None:
        self._bus = bus
        self._port = port
        self._report = BusReport(is_up=False)
        self._slaves: dict[int, SlaveReport] = {}
        self._seen: dict[int, Seen] = {}
        self._facts = SlaveFacts(bus, port)
        self._found: tuple[Found, ...] | None = None
        self._detection = Detection()
        self._codes: dict[int, int] = {}
        self._wanted: dict[int, int] = {}
        self._fixed: set[int] = set()
        self._base: dict[tuple[int, Live], int] = {}
        self._rates = (0.0, 0, 0, 0, 0)
        self._until_s = self._registers_until_s = 0.0
        self._turn = asyncio.Lock()
        self._tasks: set[asyncio.Task[None]] = set()

    async def refresh(self, *, with_registers: bool, place: int | None = None) -> None:
        """See to it that what is shown is not old; a bus that is down shows no slaves.

        Args:
            with_registers: Whether registers of slaves are shown.
            place: Of the slave whose configuration is shown, in the order of the bus.
        """
        if self.is_fresh(with_registers=with_registers, place=place):
            return
        loop = asyncio.get_running_loop()
        async with self._turn:
            if loop.time() >= self._until_s:
                await self._look()
                self._until_s = loop.time() + FRESH_S
            if with_registers and self._is_blind(loop.time(), place):
                await self._look_closely()
                self._registers_until_s = loop.time() + FRESH_S
            slave = self._at(place)
            if slave is not None:
                await self._facts.ask(slave)

    def is_fresh(self, *, with_registers: bool, place: int | None = None) -> bool:
        """Say whether :meth:`refresh` has nothing to do."""
        slave = self._at(place)
        if slave is not None and not self._facts.is_known(slave):
            return False
        now_s = asyncio.get_running_loop().time()
        return now_s < self._until_s and not (with_registers and self._is_blind(now_s, place))

    def configured(self) -> Sequence[int]:
        """Return the station addresses of the configuration."""
        return tuple(self._slaves)

    def detected(self) -> Sequence[int]:
        """Return those that the last scan has found; before one, those that answer."""
        if self._found is not None:
            return tuple(each.station for each in self._found)
        return tuple(station for station, slave in self._slaves.items() if slave.state)

    def of_configured(self, station: int, key: Live) -> Any:
        """Return what *key* stands for, of a configured slave; 0 for what nobody knows."""
        slave = self._slaves.get(station)
        if slave is None:
            return "" if key in _TEXTS else 0
        dl = self._seen.get(station, Seen()).dl
        return configured_value(slave, dl, self._facts.of(station), key)

    def of_detected(self, station: int, key: Live) -> Any:
        """Return what *key* stands for, of a slave that was found."""
        for each in self._found or ():
            if each.station == station:
                return _of_found(each, key)
        if key is Live.DL_STATUS:
            return self._seen.get(station, Seen()).dl_word
        return self.of_configured(station, key)

    def of_diagnosis(self, station: int, key: Live) -> Any:
        """Return what *key* stands for, of how a configured slave is."""
        seen = self._seen.get(station, Seen())
        if key in _NEIGHBOURS:
            return neighbour(self._seen, tuple(self._slaves), station, _NEIGHBOURS.index(key))
        if key in _COUNTED:
            return self._since_reset(station, key)
        slave = self._slaves.get(station)
        return {
            Live.AL_STATUS: int.from_bytes(seen.al.encode()[:2], "little"),
            Live.AL_CONTROL: self._wanted.get(station, slave.target if slave else 0),
            Live.AL_STATUS_CODE: self._last_code(station),
            Live.LINK_CONNECTION: seen.dl.link << PORTS | communicating(seen.dl),
            Live.LINK_CONTROL: seen.loops,
            Live.WKC_ERRORS: self._since_reset(0, Live.WKC_ERRORS),
            Live.FIXED_LINKS: station in self._fixed,
            Live.HAS_NEW_DIAGNOSIS: False,
        }.get(key, 0)

    def of_master(self, key: Live) -> Any:
        """Return what *key* stands for, of the master itself."""
        status, count = self._detection
        _, _, _, cyclic, acyclic = self._rates
        return {
            Live.DETECT_REQUEST: bytes(2),
            Live.DETECT_STATUS: status,
            Live.DETECT_RESPONSE: bytes((status, 0, 0, 0)) + count.to_bytes(2, "little"),
            Live.LOST_CYCLIC: self._since_reset(0, Live.LOST_CYCLIC),
            Live.LOST_ACYCLIC: self._since_reset(0, Live.LOST_ACYCLIC),
            Live.RATE_CYCLIC: cyclic,
            Live.RATE_ACYCLIC: acyclic,
            Live.STATE: max((slave.state for slave in self._slaves.values()), default=1) or 1,
            Live.RESET: False,
        }.get(key, 0)

    def write_slave(self, station: int, key: Live, value: int) -> None:
        """Ask for a state, or set the loops of ports; what goes wrong later is logged."""
        if key is Live.AL_CONTROL:
            target = value & 0x0F
            if target not in _STATES or value >> _AL_CONTROL_BITS:
                raise SdoAbortError(AbortCode.VALUE, 0xA000, 2, f"{value:#x} asks for no AL state")
            self._wanted[station] = value
            self._start(self._bring(station, AlState(target)))
        elif key is Live.LINK_CONTROL:
            access = [fpwr(station, LOOPS, bytes((value,)))]
            self._start(self._bus.transfer(self._port, access))
            self._registers_until_s = 0.0
        elif value:
            self._fixed.add(station)
        else:
            self._fixed.discard(station)

    def write_master(self, key: Live, data: bytes) -> None:
        """Start a scan, or set counters back."""
        if key is Live.DETECT_REQUEST:
            if self._detection.status != _BUSY:
                self._detection = Detection(_BUSY)
                self._start(self._detect())
        elif any(data):
            self._reset()

    def _is_blind(self, now_s: float, place: int | None) -> bool:
        """Say whether what is known of registers is too old, where it matters."""
        return now_s >= self._registers_until_s + (0 if place is None else LINKS_FRESH_S)

    def _at(self, place: int | None) -> SlaveReport | None:
        slaves = self._report.slaves if place is not None else ()
        return slaves[place] if place is not None and place < len(slaves) else None

    async def _look(self) -> None:
        try:
            self._report = await self._bus.describe(self._port)
        except EapError:
            self._report = BusReport(is_up=False)
        slaves = self._report.slaves if self._report.is_up else ()
        self._slaves = {slave.station: slave for slave in slaves}
        self._facts.forget(at for at, slave in self._slaves.items() if not slave.state)
        self._measure()

    def _measure(self) -> None:
        """Work out frames in a second, over at least a second."""
        now_s, report = asyncio.get_running_loop().time(), self._report
        at_s, cycles, frames, _, _ = self._rates
        if not at_s or report.cycles < cycles:
            self._rates = (now_s, report.cycles, report.frames_sent, 0, 0)
        elif now_s - at_s >= 1.0:
            cyclic = (report.cycles - cycles) / (now_s - at_s)
            rest = (report.frames_sent - frames) / (now_s - at_s) - cyclic
            rates = round(cyclic), max(0, round(rest))
            self._rates = (now_s, report.cycles, report.frames_sent, *rates)

    async def _look_closely(self) -> None:
        try:
            self._seen = await self._bus.run(self._port, look_at(tuple(self._slaves)))
        except EapError:
            self._seen = {}
        for station, seen in self._seen.items():
            if seen.al.code:
                self._codes[station] = seen.al.code

    async def _bring(self, station: int, target: AlState) -> None:
        try:
            await self._bus.bring(self._port, station, target)
        except AlStatusError as exc:
            self._codes[station] = exc.code
            raise

    async def _detect(self) -> None:
        try:
            self._found = await self._bus.run(self._port, detect())
        except BaseException:
            self._detection = Detection(_FAILED)
            raise
        self._detection = Detection(_DONE, len(self._found))

    def _counter(self, station: int, key: Live) -> int:
        if key in _CRCS:
            return self._seen.get(station, Seen()).errors[_CRCS.index(key)]
        report, slave = self._report, self._slaves.get(station)
        if slave is not None:
            return slave.losses if key is Live.ABSENCES else slave.departures
        if key is Live.WKC_ERRORS:
            return report.wkc_errors
        return report.cycles_lost if key is Live.LOST_CYCLIC else report.frames_lost

    def _last_code(self, station: int) -> int:
        """Return the AL status code of when a slave last left its state, or that was seen last."""
        slave = self._slaves.get(station)
        has_left = self._since_reset(station, Live.ABNORMAL_CHANGES)
        return (has_left and slave and slave.al_code) or self._codes.get(station, 0)

    def _since_reset(self, station: int, key: Live) -> int:
        return max(0, self._counter(station, key) - self._base.get((station, key), 0))

    def _reset(self) -> None:
        self._codes.clear()
        keys = [(0, key) for key in (Live.WKC_ERRORS, Live.LOST_CYCLIC, Live.LOST_ACYCLIC)]
        keys += [(station, key) for station in self._slaves for key in _COUNTED]
        self._base = {key: self._counter(*key) for key in keys}

    def _start(self, work: Coroutine[Any, Any, Any]) -> None:
        task = asyncio.get_running_loop().create_task(self._finish(work))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _finish(self, work: Awaitable[Any]) -> None:
        try:
            await work
        except EapError as exc:
            logger.warning("%s/%s: %s", self._port.station, self._port.port, exc)


_NEIGHBOURS = (Live.NEIGHBOUR_0, Live.NEIGHBOUR_1, Live.NEIGHBOUR_2, Live.NEIGHBOUR_3)
_CRCS = (Live.CRC_0, Live.CRC_1, Live.CRC_2, Live.CRC_3)
_COUNTED = (*_CRCS, Live.ABSENCES, Live.ABNORMAL_CHANGES)
"""Of each slave."""
_TEXTS = frozenset((Live.TYPE, Live.NAME))


def _of_found(found: Found, key: Live) -> int:
    identity = found.identity
    return {
        Live.ADDRESS: found.station,
        Live.VENDOR: identity.vendor,
        Live.PRODUCT: identity.product,
        Live.REVISION: identity.revision,
        Live.SERIAL: identity.serial,
        Live.DL_STATUS: found.dl_word,
    }.get(key, 0)
