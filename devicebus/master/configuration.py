"""Configuration of one slave, carried out in the transitions of its state machine.

PDO mapping, PDO assignment and start-up writes go through the mailbox; watchdogs, SYNC0 and SYNC1
are registers.  An error names the slave, the transition and the object that was refused.
"""

from __future__ import annotations

from typing import TypeVar

from devicebus.errors import BusError, FrameLostError, MailboxClosedError
from devicebus.mailbox import coe_client, soe_client
from devicebus.mailbox.conversation import Conversation
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.master.bus import BusSlave, BusState
from devicebus.master.clocks import start_sync, stop_sync
from devicebus.master.mailboxes import Mailbox
from devicebus.master.pdo import (
    ProcessDataChannel,
    channels_from_sii,
    read_channels,
    write_configuration,
)
from devicebus.master.procedure import Procedure, Sleep, Task, write
from devicebus.master.telegrams import read_telegrams, write_lists
from devicebus.wire.alstatus import AlState
from devicebus.wire.register import Register
from devicebus.wire.sii import SiiProtocol
from eap.codec.soe import Idn
from eap.errors import EapError
from eap.ids import ObjectId
from eap.od.slave_config import IdnWrite, SdoWrite, SlaveConfig, Transition

# The register counts (n + 2) periods of 40 ns.
WATCHDOG_DIVIDER = 2498
"""Watchdog divider for steps of 100 µs."""
_STEPS_PER_MS = 10
MAX_WATCHDOG_MS = 0xFFFF // _STEPS_PER_MS
_WATCHDOG_TRIGGER = 0x40
_MS = 1_000_000
_SHOWN_BYTES = 8

T = TypeVar("T")

# A message of a conversation takes about a cycle.  Checks every 100 µs resumed the procedures of
# 200 slaves 770,000 times during one start-up.
_FIRST_PAUSE_NS = 100_000
# Pause between two checks of a task; it doubles from the first to this.
_MAX_PAUSE_NS = 2_000_000


def transition_of(current: AlState, step: AlState) -> Transition | None:
    """Return the transition of a state change; None for those from and to BOOT."""
    return _TRANSITIONS.get((current, step))


_LETTERS = {AlState.INIT: "I", AlState.PREOP: "P", AlState.SAFEOP: "S", AlState.OP: "O"}
_TRANSITIONS = {
    (current, step): Transition(one + other)
    for current, one in _LETTERS.items()
    for step, other in _LETTERS.items()
    if one + other in {*Transition}
}


def state_timeout_ns(config: SlaveConfig, current: AlState, step: AlState) -> int | None:
    """Return the configured time-out of a state change; None is that of the standard."""
    timeouts = config.timeouts
    if step is AlState.INIT:
        limit_ms = timeouts.back_to_init_ms
    elif step is AlState.PREOP:
        limit_ms = timeouts.preop_ms
    elif current is AlState.OP:
        limit_ms = timeouts.back_to_safeop_ms
    else:
        limit_ms = timeouts.safeop_op_ms
    return None if limit_ms is None else limit_ms * _MS


def wait_for(task: Task[T]) -> Procedure[T]:
    """Wait within a procedure for another task; return its result."""
    pause_ns = _FIRST_PAUSE_NS
    while not task.is_done:
        yield Sleep(pause_ns)
        pause_ns = min(2 * pause_ns, _MAX_PAUSE_NS)
    return task.result()


def run_writes(bus: BusState, slave: BusSlave, transition: Transition) -> Procedure[None]:
    """Send the start-up writes of one transition.

    Raises BusError for the first one that fails.
    """
    for each in slave.config.writes:
        if transition in each.at:
            yield from _run_write(bus, slave, each, transition)


def prepare_safeop(bus: BusState, slave: BusSlave) -> Procedure[None]:
    """Configure the PDOs of a slave in PREOP, send the writes of PS, and read its process data.

    Does nothing if that has been done since the slave entered PREOP.

    Raises BusError if the slave refuses a part.
    """
    if slave.is_configured:
        return
    writing = _pdo_configuration(slave)
    if writing is not None:
        yield from _named(
            slave, "PDO configuration in PS", _ask(bus, slave, writing, "setting PDOs")
        )
    yield from run_writes(bus, slave, Transition.PS)
    # With the same configuration the mapping is that of the start: it is not read again.
    if not slave.is_mapped:
        yield from read_process_data(bus, slave)
        slave.is_mapped = True
    slave.is_configured = True


def _pdo_configuration(slave: BusSlave) -> Conversation[None] | None:
    """Return the conversation that sets the PDOs of a slave; None if it takes none."""
    if slave.mailbox is None:
        return None
    sizes = slave.mailbox.sizes
    if _has(slave, SiiProtocol.COE):
        return None if slave.config.fixed_pdos else write_configuration(slave.config, sizes)
    return write_lists(slave.config.mapping, sizes) if _has(slave, SiiProtocol.SOE) else None


def read_process_data(bus: BusState, slave: BusSlave) -> Procedure[None]:
    """Read the PDO mapping of a slave in PREOP."""
    sii, config = slave.found.sii, slave.config
    if slave.mailbox is not None and _has(slave, SiiProtocol.COE):
        channels = yield from _ask(bus, slave, read_channels(sii), "reading PDOs")
    else:
        channels = channels_from_sii(sii, config.assignment)
        if slave.mailbox is not None and _has(slave, SiiProtocol.SOE):
            channels = yield from _ask(bus, slave, read_telegrams(channels), "reading telegrams")
    slave.channels = with_watchdog(channels, enabled=config.watchdogs.enabled)


def with_watchdog(
    channels: tuple[ProcessDataChannel, ...], *, enabled: bool | None
) -> tuple[ProcessDataChannel, ...]:
    """Return *channels* whose outputs trigger the watchdog or not; None changes nothing."""
    if enabled is None:
        return channels
    trigger = _WATCHDOG_TRIGGER if enabled else 0
    return tuple(
        each._replace(control=each.control & ~_WATCHDOG_TRIGGER | trigger)
        if each.is_output
        else each
        for each in channels
    )


def prepare_registers(bus: BusState, slave: BusSlave) -> Procedure[None]:
    """Write the registers that a slave checks on the way to SAFEOP: watchdogs, SYNC0 and SYNC1.

    Raises BusError if it has no clock but needs one.
    """
    station, config = slave.station, slave.config
    limit_ms = config.watchdogs.process_data_ms
    limit_ms = bus.settings.watchdog_ms if limit_ms is None else limit_ms
    if limit_ms is not None:
        yield from set_watchdog(station, limit_ms)
    if config.watchdogs.pdi_ms is not None:
        yield from set_watchdog(station, config.watchdogs.pdi_ms, Register.WATCHDOG_PDI)
    signals = config.sync.signals(bus.settings.cycle_ns) if config.sync is not None else None
    if signals is not None:
        if not slave.found.esc.has_clock:
            raise BusError(f"slave {station}: SYNC0 is configured, but it has no distributed clock")
        yield from start_sync(station, signals)
    elif config.sync is not None and slave.found.esc.has_clock:
        yield from stop_sync(station, config.sync.activate)


def set_watchdog(
    station: int, timeout_ms: int, register: int = Register.WATCHDOG_PROCESS_DATA
) -> Procedure[None]:
    """Set a watchdog; 0 disables it.

    Without outputs for so long a slave leaves OP, if the process data watchdog is set.

    Raises:
        ValueError: the time does not fit the register.
        WorkingCounterError: the slave does not answer.
    """
    if not 0 <= timeout_ms <= MAX_WATCHDOG_MS:
        raise ValueError(f"watchdog of {timeout_ms} ms, expected 0 to {MAX_WATCHDOG_MS}")
    divider = WATCHDOG_DIVIDER.to_bytes(2, "little")
    steps = (timeout_ms * _STEPS_PER_MS).to_bytes(2, "little")
    yield from write(station, Register.WATCHDOG_DIVIDER, divider, "watchdog divider")
    yield from write(station, register, steps, "watchdog")


def _run_write(
    bus: BusState, slave: BusSlave, each: SdoWrite | IdnWrite, transition: Transition
) -> Procedure[None]:
    target = _target_of(each)
    where = f"start-up write of {target} in {transition}"
    needed = SiiProtocol.COE if isinstance(each, SdoWrite) else SiiProtocol.SOE
    if slave.mailbox is None or not _has(slave, needed):
        raise BusError(f"slave {slave.station}: {where}: it has no mailbox with {needed.name}")
    writing = _conversation(each, slave.mailbox.sizes)
    data = each.data[:_SHOWN_BYTES].hex(" ") + " …" * (len(each.data) > _SHOWN_BYTES)
    what = f"{where} (data {data})"
    yield from _named(slave, what, _ask(bus, slave, writing, where), target)


def _target_of(each: SdoWrite | IdnWrite) -> str:
    """Return the object of a start-up write in words."""
    if isinstance(each, IdnWrite):
        return f"{Idn.of(each.idn)}" + (f" of drive {each.drive}" if each.drive else "")
    return f"{ObjectId(each.index, each.subindex)}" + " and following" * each.complete


def _conversation(each: SdoWrite | IdnWrite, sizes: MailboxSizes) -> Conversation[None]:
    if isinstance(each, IdnWrite):
        return soe_client.write(Idn.of(each.idn), each.data, sizes, drive=each.drive)
    return coe_client.download(each.index, each.subindex, each.data, sizes, complete=each.complete)


def _has(slave: BusSlave, protocol: SiiProtocol) -> bool:
    return bool(slave.found.sii.fixed.protocols & protocol)


def _named(slave: BusSlave, what: str, procedure: Procedure[T], target: str = "") -> Procedure[T]:
    """Run a procedure; raise its error with the slave and *what* failed, which names *target*."""
    try:
        return (yield from procedure)
    except (FrameLostError, MailboxClosedError):
        raise  # they say nothing about the configuration
    except EapError as exc:
        raise BusError(f"slave {slave.station}: {what}: {_reason(exc, target)}") from None


def _reason(error: EapError, target: str) -> str:
    """Return the text of an error without the slave and the object that are named already."""
    text = str(error).removeprefix(f"{target}: ")
    return text.partition(": ")[2] if text.startswith("slave ") else text


def _ask(bus: BusState, slave: BusSlave, conversation: Conversation[T], name: str) -> Procedure[T]:
    mailbox = slave.mailbox
    assert isinstance(mailbox, Mailbox)  # noqa: S101  checked by the callers
    limit_ms = slave.config.timeouts.response_ms
    timeout_ns = None if limit_ms is None else limit_ms * _MS
    _, now_ns = yield Sleep(0)
    task = mailbox.converse(conversation, now_ns, name=name, requester=bus, timeout_ns=timeout_ns)
    return (yield from wait_for(task))
