"""Faults of a simulated segment, by script or by command, and the commands of a running segment.

Faults of frames are counted in frames and faults of slaves have a start and an end time, so that a
run is repeatable.

A command is one JSON object.  With ``set`` or ``release`` it concerns an entry, otherwise it is a
fault; ``"end": true`` ends the fault that it describes.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable
from itertools import count
from typing import Any, NamedTuple

import msgspec

from devicebus.mailbox.coe_server import CoeServer
from devicebus.mailbox.foe_server import FoeServer
from devicebus.sim.device import Device, FaultyDictionary
from devicebus.sim.devices.drive import Axes
from devicebus.sim.devices.objects import TX_PDO
from devicebus.sim.segment import SECOND_LINE, SegmentEnd, SimulatedSegment
from devicebus.sim.slave import SimulatedSlave
from devicebus.sim.spec import FaultKind, FaultSpec, Value
from devicebus.wire.alstatus import AlState, AlStatusCode
from devicebus.wire.datagram import OVERHEAD, DatagramHeader
from eap.codec.ethercat import EtherCatHeader
from eap.codec.mailbox import MailboxType
from eap.ids import ObjectId
from eap.od.abort import AbortCode


def _mailbox(slave: SimulatedSlave, spec: FaultSpec, now_ns: int, on: bool) -> None:
    del spec, now_ns
    slave.esc.channels[0].is_stuck = on


def _foe(slave: SimulatedSlave, spec: FaultSpec, now_ns: int, on: bool) -> None:
    """FoE fault: BUSY after every message, or an error code for every request."""
    del now_ns
    mailbox = slave.device.mailbox
    server = mailbox.protocols.get(MailboxType.FOE) if mailbox else None
    if isinstance(server, FoeServer):
        server.packet_time_ns = 1000 * spec.delay_us if on else 0
        server.forced_error = spec.code if on else 0


def _sdo(slave: SimulatedSlave, spec: FaultSpec, now_ns: int, on: bool) -> None:
    del now_ns
    dictionary = slave.device.dictionary
    if isinstance(dictionary, FaultyDictionary):
        index, _ = ObjectId.parse(spec.object)
        dictionary.aborts.pop(index, None)
        if on:
            dictionary.aborts[index] = spec.code or AbortCode.GENERAL


def _emergency(slave: SimulatedSlave, spec: FaultSpec, now_ns: int, on: bool) -> None:
    """Emergency fault: report an error code, and code 0 at the end of the fault.

    The axis of a drive fails as well, until it is reset.
    """
    del now_ns
    device = slave.device
    code = spec.code & 0xFFFF if on else 0
    drives = device.behaviour.drives if isinstance(device.behaviour, Axes) else ()
    if code and spec.axis < len(drives):
        # The axis reports its error by itself, and clears it when it is reset.
        drives[spec.axis].fail(code)
    else:
        device.report_error(code, axis=spec.axis)


def _tx_pdo(slave: SimulatedSlave, spec: FaultSpec, now_ns: int, on: bool) -> None:
    """TxPDO fault: send an unsolicited TxPDO through the mailbox."""
    del now_ns
    mailbox = slave.device.mailbox
    server = mailbox.protocols.get(MailboxType.COE) if mailbox else None
    index, _ = ObjectId.parse(spec.object)
    data = slave.device.process_data.read_pdo(index)
    if on and isinstance(server, CoeServer) and data is not None:
        server.send_tx_pdo(index - TX_PDO, data)


def _eeprom(slave: SimulatedSlave, spec: FaultSpec, now_ns: int, on: bool) -> None:
    """EEPROM fault: delay each command; without a delay no command is acknowledged."""
    del now_ns
    eeprom = slave.esc.eeprom
    eeprom.extra_ns = 1000 * spec.delay_us if on else 0
    eeprom.is_broken = on and not spec.delay_us


def _al_error(slave: SimulatedSlave, spec: FaultSpec, now_ns: int, on: bool) -> None:
    del now_ns
    if on:
        slave.fail(spec.code or AlStatusCode.UNSPECIFIED)


def _refuse(slave: SimulatedSlave, spec: FaultSpec, now_ns: int, on: bool) -> None:
    del now_ns
    state = AlState[spec.state]
    slave.refused_states.pop(state, None)
    if on:
        slave.refused_states[state] = spec.code or AlStatusCode.UNSPECIFIED


def _drift(slave: SimulatedSlave, spec: FaultSpec, now_ns: int, on: bool) -> None:
    drift_ppm = spec.drift_ppm if on else slave.esc.settings.drift_ppm
    slave.esc.clock.set_drift(drift_ppm, now_ns)


SLAVE_FAULTS: dict[FaultKind, Callable[[SimulatedSlave, FaultSpec, int, bool], None]] = {
    FaultKind.MAILBOX: _mailbox,
    FaultKind.FOE: _foe,
    FaultKind.SDO: _sdo,
    FaultKind.EEPROM: _eeprom,
    FaultKind.EMERGENCY: _emergency,
    FaultKind.TX_PDO: _tx_pdo,
    FaultKind.AL_ERROR: _al_error,
    FaultKind.REFUSE: _refuse,
    FaultKind.DRIFT: _drift,
}


def find_entry(device: Device, text: str) -> tuple[int, int]:
    """Return index and subindex of the entry that *text* names.

    Args:
        device: Device with the entry.
        text: Name of an input or output, name of another entry, or index and subindex such as
            ``0x6000:01``; an index that begins with a letter needs 0x or a subindex.

    Raises:
        ValueError: no entry, or several entries, have this name.
    """
    if text in device.channels:
        return device.channels[text]
    named = [
        ObjectId(item.index, subindex)
        for item in device.dictionary
        for subindex, entry in item.entries.items()
        if entry.name == text
    ]
    if not named and (text[:1].isdigit() or ":" in text):
        index, subindex = entry = ObjectId.parse(text)
        if index in device.dictionary and subindex in device.dictionary[index].entries:
            return entry
        raise ValueError(f"{device.name} has no entry {entry}")
    if not named:
        known = ", ".join(device.channels) or "none"
        raise ValueError(f"{device.name} has no entry {text!r} (inputs and outputs: {known})")
    if len(named) > 1:
        names = ", ".join(map(str, named))
        raise ValueError(f"{device.name} has several entries {text!r}: {names}")
    return named[0]


_MS = 1_000_000
_ON_FRAMES = frozenset((FaultKind.LOSS, FaultKind.DELAY, FaultKind.CORRUPT, FaultKind.WKC))


class Outgoing(NamedTuple):
    """Frame on its way back; *origin* is the value that it was received with."""

    frame: bytearray
    side: SegmentEnd
    origin: Any


class FaultySegment:
    """Segment with faults.

    Args:
        segment: Segment without faults.
        script: Faults with their times, counted from the first call with a time.
    """

    def __init__(self, segment: SimulatedSegment, script: Iterable[FaultSpec] = ()) -> None:
        self.segment = segment
        self._numbers = {slave.device.name: n for n, slave in enumerate(segment.slaves)}
        self._script = list(script)
        for spec in self._script:
            self.check(spec)
        self._started_ns: int | None = None
        self._due: list[tuple[int, int, Callable[[int], None]]] = []
        self._order = count()
        self._on_frames: dict[FaultSpec, int] = {}
        self._returning: list[tuple[int, int, Outgoing]] = []

    def check(self, spec: FaultSpec) -> None:
        """Raise ValueError for an unknown slave, object or state."""
        needs_slave = spec.kind not in _ON_FRAMES or spec.kind is FaultKind.CORRUPT
        if spec.second:
            if spec.kind is not FaultKind.CUT or not self.segment.is_ring:
                raise ValueError("second: only the cable of a ring (`ring: true`) has it, with cut")
            needs_slave = False
        if needs_slave and spec.slave not in self._numbers:
            known = ", ".join(self._numbers)
            problem = f"no slave {spec.slave!r}" if spec.slave else "it needs a slave"
            raise ValueError(f"fault {spec.kind.value}: {problem} (one of {known})")
        if spec.kind is FaultKind.SDO:
            ObjectId.parse(spec.object)
        is_tx_pdo = spec.kind is FaultKind.TX_PDO
        if is_tx_pdo and not 0 <= ObjectId.parse(spec.object).object_index - TX_PDO < 0x200:
            raise ValueError(f"fault tx-pdo: {spec.object} is no TxPDO (0x1A00 to 0x1BFF)")
        if spec.kind is FaultKind.REFUSE and spec.state not in AlState.__members__:
            known = ", ".join(AlState.__members__)
            raise ValueError(f"fault refuse: no state {spec.state!r} (one of {known})")

    def begin(self, spec: FaultSpec, now_ns: int) -> None:
        """Start a fault now, or at *at_ms* from now.

        Raises:
            ValueError: the slave, object or state is unknown.
        """
        self.check(spec)
        at = now_ns + spec.at_ms * _MS
        self._push(at, lambda now: self._switch(spec, now, on=True))
        if spec.for_ms is not None:
            self._push(at + spec.for_ms * _MS, lambda now: self._switch(spec, now, on=False))
        self._run_due(now_ns)

    def end(self, spec: FaultSpec, now_ns: int) -> None:
        """End the fault that *spec* describes."""
        self.check(spec)
        self._switch(spec, now_ns, on=False)

    def set_value(self, slave: str, entry: str, value: object, now_ns: int) -> None:
        """Hold an entry of a slave at *value*.

        Args:
            slave: Name of the slave.
            entry: Name of an input, output or other entry, or index and subindex (``0x6000:1``).
            value: Value of the entry's type.
            now_ns: Present time.

        Raises:
            ValueError: slave or entry are unknown, or the value does not fit.
        """
        found = self._slave(slave)
        found.device.override(*find_entry(found.device, entry), value)
        found.offer_inputs(now_ns)

    def release(self, slave: str, entry: str, now_ns: int) -> None:
        """End :meth:`set_value`; raise ValueError if the entry was not set."""
        found = self._slave(slave)
        if not found.device.release(*find_entry(found.device, entry)):
            raise ValueError(f"{slave}: {entry} was not set")
        found.offer_inputs(now_ns)

    def _slave(self, name: str) -> SimulatedSlave:
        if name not in self._numbers:
            raise ValueError(f"no slave {name!r} (one of {', '.join(self._numbers)})")
        return self.segment.slaves[self._numbers[name]]

    def receive_frame(
        self,
        frame: bytearray,
        now_ns: int,
        *,
        side: SegmentEnd = SegmentEnd.PRIMARY,
        origin: Any = None,
    ) -> None:
        """Handle a frame from the master; :meth:`frames_to_send` returns it when it is back."""
        self.handle_timeout(now_ns)
        delay_ns = 0
        change_wkc = False
        for spec in [spec for spec in self._on_frames if self._hits(spec)]:
            if spec.kind is FaultKind.LOSS:
                return
            if spec.kind is FaultKind.CORRUPT:
                self.segment.break_frame(frame, now_ns, side, self._numbers[spec.slave])
                return
            if spec.kind is FaultKind.DELAY:
                delay_ns += 1000 * spec.delay_us
            change_wkc |= spec.kind is FaultKind.WKC
        out = self.segment.process_frame(frame, now_ns, side)
        if out is None:
            return
        if change_wkc:
            spoil_working_counters(frame)
        entry = (now_ns + delay_ns, next(self._order), Outgoing(frame, out, origin))
        # By time, then by number: frames with the same delay keep their order.
        heapq.heappush(self._returning, entry)

    def frames_to_send(self, now_ns: int) -> list[Outgoing]:
        """Return and remove the frames that are back."""
        ready = []
        while self._returning and self._returning[0][0] <= now_ns:
            ready.append(heapq.heappop(self._returning)[2])
        return ready

    def next_timeout(self) -> int | None:
        """Return the time of the next frame, fault or slave timer."""
        first = self.segment.next_timeout()
        for queue in (self._due, self._returning):
            if queue and (first is None or queue[0][0] < first):
                first = queue[0][0]
        return first

    def handle_timeout(self, now_ns: int) -> None:
        """Start and end faults, and handle the timers of slaves."""
        if self._started_ns is None:
            self._started_ns = now_ns
            for spec in self._script:
                self.begin(spec, now_ns)
        self._run_due(now_ns)
        self.segment.handle_timeout(now_ns)

    def _push(self, at_ns: int, action: Callable[[int], None]) -> None:
        heapq.heappush(self._due, (at_ns, next(self._order), action))

    def _run_due(self, now_ns: int) -> None:
        while self._due and self._due[0][0] <= now_ns:
            heapq.heappop(self._due)[2](now_ns)

    def _hits(self, spec: FaultSpec) -> bool:
        self._on_frames[spec] += 1
        return self._on_frames[spec] % spec.every == 0

    def _switch(self, spec: FaultSpec, now_ns: int, *, on: bool) -> None:
        if spec.kind in _ON_FRAMES:
            if on:
                self._on_frames[spec] = 0
            else:
                self._on_frames.pop(spec, None)
            return
        number = SECOND_LINE if spec.second else self._numbers[spec.slave]
        if spec.kind is FaultKind.CUT:
            (self.segment.cut if on else self.segment.mend)(number)
        elif spec.kind is FaultKind.POWER:
            self.segment.switch(number, on=not on)
        else:
            SLAVE_FAULTS[spec.kind](self.segment.slaves[number], spec, now_ns, on)


def spoil_working_counters(frame: bytearray) -> None:
    """Decrement every working counter of a frame."""
    offset = EtherCatHeader.SIZE
    while offset + OVERHEAD <= len(frame):
        header = DatagramHeader.decode(frame, offset)
        at = offset + DatagramHeader.SIZE + header.length
        wkc = int.from_bytes(frame[at : at + 2], "little")
        frame[at : at + 2] = max(0, wkc - 1).to_bytes(2, "little")
        offset += OVERHEAD + header.length
        if not header.more:
            break


class EntryValue(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Entry of a slave and the value to hold."""

    slave: str
    entry: str
    value: Value


class EntryName(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Entry of a slave to release."""

    slave: str
    entry: str


class _SetCommand(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    set: EntryValue


class _ReleaseCommand(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    release: EntryName


class FaultCommand(FaultSpec, frozen=True, forbid_unknown_fields=True):
    """Fault command; *end* ends the fault."""

    end: bool = False


def execute_command(segment: FaultySegment, command: object, now_ns: int) -> None:
    """Execute *command*, a decoded JSON object.

    Raises:
        ValueError: the command is invalid; the text has the reason.
    """
    if not isinstance(command, dict):
        raise ValueError("a command is a JSON object")  # noqa: TRY004  invalid user input
    try:
        if "set" in command:
            entry = msgspec.convert(command, _SetCommand).set
            segment.set_value(entry.slave, entry.entry, entry.value, now_ns)
        elif "release" in command:
            name = msgspec.convert(command, _ReleaseCommand).release
            segment.release(name.slave, name.entry, now_ns)
        else:
            _check_keys(command)
            numbers = {
                key: value if key in _TEXTS else _number(value) for key, value in command.items()
            }
            _switch(segment, msgspec.convert(numbers, FaultCommand), now_ns)
    except msgspec.MsgspecError as exc:
        raise ValueError(str(exc)) from None


_TEXTS = frozenset(("kind", "object", "slave", "state"))


def _number(value: object) -> object:
    """Return the number that a text means, such as 0x7305, which JSON cannot write as a number."""
    try:
        return int(value, 0) if isinstance(value, str) else value
    except ValueError:
        return value  # the conversion says what is expected


def _check_keys(command: dict[str, object]) -> None:
    known = (*FaultSpec.__struct_fields__, "end")
    for key in command:
        if key not in known:
            raise ValueError(f"a fault has no key {key!r} (one of {', '.join(known)})")


def _switch(segment: FaultySegment, command: FaultCommand, now_ns: int) -> None:
    given = msgspec.structs.asdict(command)
    is_end = given.pop("end")
    (segment.end if is_end else segment.begin)(FaultSpec(**given), now_ns)
