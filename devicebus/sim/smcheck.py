"""What a slave checks before it changes its state (ETG.1000.6, ETG.1020)."""

from __future__ import annotations

from devicebus.mailbox.protocol import MINIMUM_SIZE
from devicebus.sim.device import Device
from devicebus.sim.esc import Esc
from devicebus.sim.syncmanager import SyncChannel
from devicebus.wire.alstatus import AlState, AlStatusCode
from devicebus.wire.register import Register

_BUFFERS = 3

ALLOWED: dict[AlState, frozenset[AlState]] = {
    AlState.INIT: frozenset((AlState.INIT, AlState.PREOP, AlState.BOOT)),
    AlState.PREOP: frozenset((AlState.INIT, AlState.PREOP, AlState.SAFEOP)),
    AlState.SAFEOP: frozenset((AlState.INIT, AlState.PREOP, AlState.SAFEOP, AlState.OP)),
    AlState.OP: frozenset((AlState.INIT, AlState.PREOP, AlState.SAFEOP, AlState.OP)),
    AlState.BOOT: frozenset((AlState.INIT, AlState.BOOT)),
}
"""To which states a master may ask from each."""


def check_mailbox(esc: Esc) -> bool:
    """Whether sync managers 0 and 1 are two mailboxes in the right directions, side by side."""
    receive, send = esc.channels[:2]
    if not (_is_mailbox(receive) and _is_mailbox(send)):
        return False
    if not receive.master_writes or send.master_writes:
        return False
    return receive.end <= send.start or send.end <= receive.start


def check_process_data(esc: Esc, device: Device) -> AlStatusCode:
    """Return why the sync managers of the process data do not fit the mapping, or NO_ERROR."""
    sides = (
        (device.output_channel, True, device.process_data.outputs.size,
         AlStatusCode.OUTPUT_CONFIGURATION),
        (device.input_channel, False, device.process_data.inputs.size,
         AlStatusCode.INPUT_CONFIGURATION),
    )  # fmt: skip
    for number, written, size, code in sides:
        channel = esc.channels[number]
        if channel.length != size:
            return code
        if size and (channel.is_mailbox or channel.master_writes is not written):
            return AlStatusCode.SYNC_MANAGER
        if size and any(_meet(channel, each) for each in esc.channels if each is not channel):
            return AlStatusCode.SYNC_MANAGER
    return AlStatusCode.NO_ERROR


def check_clock(esc: Esc, device: Device) -> AlStatusCode:
    """Return why the distributed clock is not set up as the device needs it, or NO_ERROR."""
    asked = esc.memory[Register.DC_ACTIVATION] & 0x02
    if (asked or device.needs_sync0) and not esc.clock.sync0_is_active:
        return AlStatusCode.DC_SYNC_CONFIGURATION
    return AlStatusCode.NO_ERROR


def _meet(buffered: SyncChannel, other: SyncChannel) -> bool:
    """Whether a channel lies where the three buffers of *buffered* are."""
    end = buffered.start + _BUFFERS * buffered.length
    other_end = other.start + (1 if other.is_mailbox else _BUFFERS) * other.length
    return other.length > 0 and buffered.start < other_end and other.start < end


def _is_mailbox(channel: SyncChannel) -> bool:
    return channel.is_enabled and channel.is_mailbox and channel.length >= MINIMUM_SIZE
