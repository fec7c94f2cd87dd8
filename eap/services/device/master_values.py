"""Dictionary of a master, for its mailbox gateway and for ADS (ETG.1510).

Reading an entry cannot wait for the bus, so a server of the dictionary refreshes the values behind
an object before it reads the object.  Slaves and their states come from the view of the bus.
Counters, registers and objects of slaves are cached values with an age up to which they are shown;
events of the bus between two reads of them are not seen.
"""

from __future__ import annotations

import asyncio
import logging
import math
import os
from collections.abc import Awaitable, Callable, Coroutine, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from itertools import islice
from typing import Any, Generic, NamedTuple, TypeVar

from devicebus.errors import AlStatusError
from devicebus.mailbox import coe_client
from devicebus.mailbox.conversation import Conversation
from devicebus.wire.alstatus import AlState
from devicebus.wire.datagram import fpwr
from devicebus.wire.register import DlStatus
from devicebus.wire.sii import SiiProtocol
from eap.device.eap_dictionary import DeviceIdentity
from eap.device.live_dictionaries import MasterDictionary
from eap.errors import EapError
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.profiles.master1100 import CONFIGURED, DIAGNOSIS, MasterLive
from eap.runtime.engine_messages import BusReport, SlaveDescription
from eap.services.device.master_registers import (
    LOOPS,
    PORTS,
    DetectedSlave,
    SlaveRegisters,
    communicating,
    detect_slaves,
    neighbour,
    read_registers,
)
from eap.services.slaves.bus_client import BusClient
from eap.services.tasks import TaskSet

T = TypeVar("T")

FRESH_S = 0.1
"""Age up to which counters and registers are shown."""
LINKS_FRESH_S = 1.1
"""Age up to which registers are shown in the configuration, which has only links of them."""
FACTS_ANSWER_S = 0.3
"""Time that a client of the dictionary waits for the objects of a slave."""
_DEVICE_TYPE, _HISTORY = 0x1000, 0x10F3
_OF_REGISTERS = range(0x8000, 0xB000)
_OF_CONFIGURED = range(CONFIGURED.first, CONFIGURED.last + 1)
_OF_COUNTERS = frozenset((*range(DIAGNOSIS.first, DIAGNOSIS.last + 1), 0xF120, 0xF200))
_STATES = frozenset((AlState.INIT, AlState.PREOP, AlState.SAFEOP, AlState.OP, AlState.BOOT))
_AL_CONTROL_BITS = 6
"""State, acknowledgement, request for an id; there is nothing above them."""
_RATE_S = 1.0
"""Frames in a second are counted over this time at least."""
_BUSY, _DONE, _FAILED = 255, 1, 3
"""Of a command that has a response; 0 is one that has none (ETG.1000.6, type COMMAND_PAR)."""
_NEIGHBOURS = (
    MasterLive.NEIGHBOUR_0,
    MasterLive.NEIGHBOUR_1,
    MasterLive.NEIGHBOUR_2,
    MasterLive.NEIGHBOUR_3,
)
_CRCS = (MasterLive.CRC_0, MasterLive.CRC_1, MasterLive.CRC_2, MasterLive.CRC_3)
_COUNTED = (*_CRCS, MasterLive.ABSENCES, MasterLive.ABNORMAL_CHANGES)
"""Counters of each slave."""
_TEXTS = frozenset((MasterLive.TYPE, MasterLive.NAME))
_NO_LINK, _NO_COMMUNICATION, _LINK_MISSING, _ADDITIONAL_LINK = 1, 2, 4, 8
_PORT_SHIFT = 4
_PORTS_TO_OTHERS = (1, 2, 3)

logger = logging.getLogger(__name__)


class MasterDictionaryProvider:
    """The dictionary of the master behind one bus port, and the values that it shows.

    Args:
        bus: Of the master.
        release: Of this software.
        full: As the dictionary has it.
        padded: Likewise.

    Attributes:
        dictionary: To be served after :attr:`refresh`.
        refresh: Refreshes the values that the object at an index shows.
        is_fresh: Returns whether the object at an index may be read at once.
        close: Ends what writes to the dictionary have begun.
    """

    def __init__(
        self,
        bus: BusClient,
        release: str,
        *,
        full: bool = False,
        padded: bool = False,
    ) -> None:
        view = MasterView(bus)
        self.refresh, self.is_fresh, self.close = view.refresh, view.is_fresh, view.close
        identity = DeviceIdentity(
            device_name=f"EtherCAT master {bus.name}",
            hardware_version=os.uname().machine,
            software_version=release,
        )
        self.dictionary = MasterDictionary(view, identity, full=full, padded=padded)


class CachedValue(Generic[T]):
    """A value that is read again when it is older than its user allows.

    Args:
        read: Reads it.
        value: Until it is read for the first time.
    """

    def __init__(self, read: Callable[[], Awaitable[T]], value: T) -> None:
        self.value = value
        self._read = read
        self._read_s = -math.inf

    def is_younger(self, age_s: float) -> bool:
        """Return whether it was read within *age_s*."""
        # Never read and any age allowed is NaN here, which compares as too old.
        return asyncio.get_running_loop().time() < self._read_s + age_s

    async def refresh(self, age_s: float) -> None:
        """Read it if it is older than *age_s*."""
        if not self.is_younger(age_s):
            self.value = await self._read()
            self._read_s = asyncio.get_running_loop().time()

    def expire(self) -> None:
        """Have it read the next time."""
        self._read_s = -math.inf


class SlaveFacts(NamedTuple):
    """Objects of a slave that the dictionary repeats; 0 for one that does not answer in time."""

    device_type: int = 0
    has_history: bool = False


class Detection(NamedTuple):
    """The last scan, as object 0xF002 shows it."""

    status: int = 0
    slaves: tuple[DetectedSlave, ...] | None = None
    """None before one has ended."""


class Rates(NamedTuple):
    """Frames in a second, and the counts from which the next rates are computed."""

    at_s: float = 0.0
    cycles: int = 0
    frames: int = 0
    cyclic: int = 0
    acyclic: int = 0


class BusCounters(NamedTuple):
    """Counters of the bus, and rates since an earlier report."""

    report: BusReport = BusReport(is_up=False)
    rates: Rates = Rates()


class MasterView:
    """The master behind one bus port, as values of its dictionary.

    Args:
        bus: Of the master.
    """

    def __init__(self, bus: BusClient) -> None:
        self._bus = bus
        self._view = bus.view
        self._view.on_change.append(self._forget_facts)
        self._counters = CachedValue(self._read_counters, BusCounters())
        self._registers = CachedValue(self._read_registers, dict[int, SlaveRegisters]())
        self._facts: dict[int, CachedValue[SlaveFacts]] = {}
        """By station address, as long as the slave answers."""
        self._detection = Detection()
        self._codes: dict[int, int] = {}
        """AL status codes that were seen last."""
        self._requested: dict[int, int] = {}
        """AL control as it was written last."""
        self._fixed: set[int] = set()
        """Slaves whose loops stay as they are written."""
        self._base: dict[tuple[int, MasterLive], int] = {}
        """Counters at the last reset."""
        self._lock = asyncio.Lock()
        self._tasks = TaskSet(f"dictionary of the master of {bus.name}")

    async def refresh(self, index: int) -> None:
        """Refresh what the object at *index* shows; a bus that is down has no slaves."""
        if self.is_fresh(index):
            return
        # Concurrent readers wait for one read of the bus instead of causing one each.
        async with self._lock:
            with suppress(EapError):
                await self._view.current()
            for value, age_s in self._values_behind(index):
                await value.refresh(age_s)

    async def close(self) -> None:
        """End the scans and changes of states that are under way."""
        await self._tasks.close()

    def is_fresh(self, index: int) -> bool:
        """Return whether :meth:`refresh` has nothing to do."""
        if not self._view.is_current:
            return False
        for value, age_s in self._values_behind(index):  # noqa: SIM110  all() takes longer
            if not value.is_younger(age_s):
                return False
        return True

    def _values_behind(self, index: int) -> Iterator[tuple[CachedValue[Any], float]]:
        """Yield the cached values that the object at *index* shows, with their greatest ages."""
        if index in _OF_COUNTERS:
            yield self._counters, FRESH_S
        if index in _OF_REGISTERS:
            yield self._registers, LINKS_FRESH_S if index in _OF_CONFIGURED else FRESH_S
        if index in _OF_CONFIGURED and (facts := self._facts_at(index)) is not None:
            yield facts, math.inf

    @property
    def slaves(self) -> Mapping[int, SlaveDescription]:
        """Slaves of a bus that is up, by station address."""
        bus = self._view.latest
        return bus.slaves if bus.is_up and self._view.is_current else {}

    def configured(self) -> Sequence[int]:
        """Return the station addresses of the configuration."""
        return tuple(self.slaves)

    def detected(self) -> Sequence[int]:
        """Return those that the last scan has found; before one, those that answer."""
        if self._detection.slaves is not None:
            return tuple(each.station for each in self._detection.slaves)
        return tuple(station for station, slave in self.slaves.items() if slave.state)

    def of_configured(self, station: int, key: MasterLive) -> Any:
        """Return the value of *key* for a configured slave; 0 for one that is not known."""
        slave = self.slaves.get(station)
        if slave is None:
            return "" if key in _TEXTS else 0
        facts = self._facts.get(station)
        value = SlaveFacts() if facts is None else facts.value
        return configured_value(slave, self._registers_of(station).dl, value, key)

    def of_detected(self, station: int, key: MasterLive) -> Any:
        """Return the value of *key* for a slave that was found."""
        for each in self._detection.slaves or ():
            if each.station == station:
                return _detected_value(each, key)
        if key is MasterLive.DL_STATUS:
            return self._registers_of(station).dl_word
        return self.of_configured(station, key)

    def of_diagnosis(self, station: int, key: MasterLive) -> Any:
        """Return the value of *key* for the diagnosis of a configured slave."""
        registers = self._registers_of(station)
        if key in _NEIGHBOURS:
            return neighbour(
                self._registers.value, self.configured(), station, _NEIGHBOURS.index(key)
            )
        if key in _COUNTED:
            return self._since_reset(station, key)
        slave = self.slaves.get(station)
        return {
            MasterLive.AL_STATUS: int.from_bytes(registers.al.encode()[:2], "little"),
            MasterLive.AL_CONTROL: self._requested.get(station, slave.target if slave else 0),
            MasterLive.AL_STATUS_CODE: self._last_code(station),
            MasterLive.LINK_CONNECTION: registers.dl.link << PORTS | communicating(registers.dl),
            MasterLive.LINK_CONTROL: registers.loops,
            MasterLive.WKC_ERRORS: self._since_reset(0, MasterLive.WKC_ERRORS),
            MasterLive.FIXED_LINKS: station in self._fixed,
            MasterLive.HAS_NEW_DIAGNOSIS: False,
        }.get(key, 0)

    def of_master(self, key: MasterLive) -> Any:
        """Return the value of *key* for the master itself."""
        rates = self._counters.value.rates
        status, count = self._detection.status, len(self._detection.slaves or ())
        count = count if status == _DONE else 0
        return {
            MasterLive.DETECT_REQUEST: bytes(2),
            MasterLive.DETECT_STATUS: status,
            MasterLive.DETECT_RESPONSE: bytes((status, 0, 0, 0)) + count.to_bytes(2, "little"),
            MasterLive.LOST_CYCLIC: self._since_reset(0, MasterLive.LOST_CYCLIC),
            MasterLive.LOST_ACYCLIC: self._since_reset(0, MasterLive.LOST_ACYCLIC),
            MasterLive.RATE_CYCLIC: rates.cyclic,
            MasterLive.RATE_ACYCLIC: rates.acyclic,
            MasterLive.STATE: max((slave.state for slave in self.slaves.values()), default=1) or 1,
            MasterLive.RESET: False,
        }.get(key, 0)

    def write_slave(self, station: int, key: MasterLive, value: int) -> None:
        """Request a state, or set the loops of ports; an error that comes later is logged."""
        if key is MasterLive.AL_CONTROL:
            target = value & 0x0F
            if target not in _STATES or value >> _AL_CONTROL_BITS:
                raise SdoAbortError(AbortCode.VALUE, 0xA000, 2, f"{value:#x} is no AL state")
            self._requested[station] = value
            self._start(self._bring(station, AlState(target)))
        elif key is MasterLive.LINK_CONTROL:
            access = [fpwr(station, LOOPS, bytes((value,)))]
            self._start(self._bus.transfer(access))
            # The next reader must see the loops as they are after the write.
            self._registers.expire()
        elif value:
            self._fixed.add(station)
        else:
            self._fixed.discard(station)

    def write_master(self, key: MasterLive, data: bytes) -> None:
        """Start a scan, or reset counters."""
        if key is MasterLive.DETECT_REQUEST:
            if self._detection.status != _BUSY:
                self._detection = self._detection._replace(status=_BUSY)
                self._start(self._detect())
        # The entry always reads 0, so each write of another value is a rising edge.
        elif any(data):
            self._reset()

    def _registers_of(self, station: int) -> SlaveRegisters:
        return self._registers.value.get(station, SlaveRegisters())

    def _facts_at(self, index: int) -> CachedValue[SlaveFacts] | None:
        """Return the objects of the configured slave at *index*, None for one without CoE."""
        slave = next(islice(self.slaves.values(), index - CONFIGURED.first, None), None)
        if slave is None or not (slave.to_slave and slave.protocols & SiiProtocol.COE):
            return None
        facts = self._facts.get(slave.station)
        if facts is None:
            read = partial(self._read_facts, slave.station)
            facts = self._facts[slave.station] = CachedValue(read, SlaveFacts())
        return facts

    def _forget_facts(self) -> None:
        """Forget the objects of slaves that do not answer: others may come in their place."""
        for station, slave in self._view.latest.slaves.items():
            if not slave.state:
                self._facts.pop(station, None)

    async def _read_facts(self, station: int) -> SlaveFacts:
        with suppress(EapError, TimeoutError):
            async with asyncio.timeout(FACTS_ANSWER_S):
                return await self._bus.converse(
                    station, _query_facts(), requester="dictionary of the master"
                )
        return SlaveFacts()

    async def _read_counters(self) -> BusCounters:
        try:
            report = await self._bus.describe()
        except EapError:
            report = BusReport(is_up=False)
        now_s, last = asyncio.get_running_loop().time(), self._counters.value.rates
        rates = last
        # The counts of a restarted engine begin at 0.
        if not last.at_s or report.cycles < last.cycles:
            rates = Rates(now_s, report.cycles, report.frames_sent)
        elif now_s - last.at_s >= _RATE_S:
            cyclic = (report.cycles - last.cycles) / (now_s - last.at_s)
            others = (report.frames_sent - last.frames) / (now_s - last.at_s) - cyclic
            per_s = round(cyclic), max(0, round(others))
            rates = Rates(now_s, report.cycles, report.frames_sent, *per_s)
        return BusCounters(report, rates)

    async def _read_registers(self) -> dict[int, SlaveRegisters]:
        if not self.slaves:
            return {}
        try:
            found = await self._bus.run(read_registers(self.configured()))
        except EapError:
            return {}
        # A slave clears its code when the error is acknowledged; the dictionary keeps the last one.
        self._codes |= {at: each.al.code for at, each in found.items() if each.al.code}
        return found

    async def _bring(self, station: int, target: AlState) -> None:
        try:
            await self._bus.bring(station, target)
        except AlStatusError as exc:
            self._codes[station] = exc.code
            raise

    async def _detect(self) -> None:
        try:
            found = await self._bus.run(detect_slaves())
        except BaseException:
            self._detection = self._detection._replace(status=_FAILED)
            raise
        self._detection = Detection(_DONE, found)

    def _counter(self, station: int, key: MasterLive) -> int:
        if key in _CRCS:
            return self._registers_of(station).errors[_CRCS.index(key)]
        slave, counters = self.slaves.get(station), self._counters.value.report
        if slave is not None:
            return slave.losses if key is MasterLive.ABSENCES else slave.departures
        if key is MasterLive.WKC_ERRORS:
            return counters.wkc_errors
        return counters.cycles_lost if key is MasterLive.LOST_CYCLIC else counters.frames_lost

    def _last_code(self, station: int) -> int:
        """Return the AL status code of when a slave last left its state, or that was seen last."""
        slave = self.slaves.get(station)
        # The code of the slave's last departure goes before codes of requests that it refused.
        has_left = self._since_reset(station, MasterLive.ABNORMAL_CHANGES)
        return (has_left and slave and slave.al_code) or self._codes.get(station, 0)

    def _since_reset(self, station: int, key: MasterLive) -> int:
        # A controller counts from 0 again after a power failure, or when another tool clears it.
        return max(0, self._counter(station, key) - self._base.get((station, key), 0))

    def _reset(self) -> None:
        self._codes.clear()
        keys = [
            (0, key)
            for key in (MasterLive.WKC_ERRORS, MasterLive.LOST_CYCLIC, MasterLive.LOST_ACYCLIC)
        ]
        keys += [(station, key) for station in self.slaves for key in _COUNTED]
        self._base = {key: self._counter(*key) for key in keys}

    def _start(self, work: Coroutine[Any, Any, Any]) -> None:
        self._tasks.start(self._finish(work))

    async def _finish(self, work: Awaitable[Any]) -> None:
        try:
            await work
        except EapError as exc:
            logger.warning("%s: %s", self._bus.name, exc)


def configured_value(
    slave: SlaveDescription, dl: DlStatus, facts: SlaveFacts, key: MasterLive
) -> Any:
    """Return the value of *key* in the configuration of a slave (0x8nnn); 0 if it is not known.

    Args:
        slave: As the engine knows it.
        dl: Its links now.
        facts: Its own objects.
        key: Of a row of the profile.
    """
    return {
        MasterLive.ADDRESS: slave.station,
        MasterLive.TYPE: slave.order or slave.name,
        MasterLive.NAME: slave.name,
        MasterLive.DEVICE_TYPE: facts.device_type,
        MasterLive.VENDOR: slave.vendor,
        MasterLive.PRODUCT: slave.product,
        MasterLive.REVISION: slave.revision,
        MasterLive.SERIAL: slave.serial,
        # In BOOT they are other ones than in the EEPROM.
        MasterLive.MAILBOX_OUT: slave.to_slave or slave.usual_to_slave,
        MasterLive.MAILBOX_IN: slave.to_master or slave.usual_to_master,
        MasterLive.LINK_STATUS: link_status(slave, dl),
        MasterLive.LINK_PRESET: slave.link_preset,
        MasterLive.PHYSICS: slave.port_physics,
        MasterLive.PROTOCOLS: slave.protocols,
        MasterLive.HAS_HISTORY: facts.has_history,
    }.get(key, 0)


def link_status(slave: SlaveDescription, dl: DlStatus) -> int:
    """Return how the links of a slave differ from those it was found with."""
    if not slave.state:
        return _NO_LINK
    alive = communicating(dl)
    status = 0
    for port in _PORTS_TO_OTHERS:
        is_expected = slave.link_preset >> port - 1 & 1
        has_link = dl.link >> port & 1
        if is_expected and not has_link:
            status |= _LINK_MISSING | 1 << _PORT_SHIFT + port
        elif has_link and not is_expected:
            status |= _ADDITIONAL_LINK | 1 << _PORT_SHIFT + port
        elif has_link and not alive >> port & 1:
            status |= _NO_COMMUNICATION | 1 << _PORT_SHIFT + port
    return status


def _detected_value(found: DetectedSlave, key: MasterLive) -> int:
    identity = found.identity
    return {
        MasterLive.ADDRESS: found.station,
        MasterLive.VENDOR: identity.vendor,
        MasterLive.PRODUCT: identity.product,
        MasterLive.REVISION: identity.revision,
        MasterLive.SERIAL: identity.serial,
        MasterLive.DL_STATUS: found.dl_word,
    }.get(key, 0)


def _query_facts() -> Conversation[SlaveFacts]:
    device_type = yield from coe_client.upload(_DEVICE_TYPE, 0)
    try:
        yield from coe_client.upload(_HISTORY, 0)
        has_history = True
    except SdoAbortError:
        has_history = False
    return SlaveFacts(int.from_bytes(device_type, "little"), has_history)
