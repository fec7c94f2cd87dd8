"""Simulated slave: EtherCAT state machine (ETG.1000.6) between a controller and a device.

It runs on events of its controller and on timers, and never blocks.
"""

from __future__ import annotations

from devicebus.mailbox.protocol import MINIMUM_SIZE
from devicebus.sim.device import Device
from devicebus.sim.esc import Esc
from devicebus.sim.syncmanager import SyncChannel
from devicebus.wire.alstatus import ERROR, WITH_MAILBOX, WITH_PROCESS_DATA, AlState, AlStatusCode
from devicebus.wire.register import AlEvent, Register
from eap.codec.mailbox import MailboxType

# A buffered sync manager uses its area and the two areas of the same length behind it.
_BUFFERS = 3

ALLOWED: dict[AlState, frozenset[AlState]] = {
    AlState.INIT: frozenset((AlState.INIT, AlState.PREOP, AlState.BOOT)),
    AlState.PREOP: frozenset((AlState.INIT, AlState.PREOP, AlState.SAFEOP)),
    AlState.SAFEOP: frozenset((AlState.INIT, AlState.PREOP, AlState.SAFEOP, AlState.OP)),
    AlState.OP: frozenset((AlState.INIT, AlState.PREOP, AlState.SAFEOP, AlState.OP)),
    AlState.BOOT: frozenset((AlState.INIT, AlState.BOOT)),
}
"""Allowed requests of a master in each state."""


def check_mailbox(esc: Esc) -> bool:
    """Return true if sync managers 0 and 1 are mailboxes in the right directions, apart."""
    receive, send = esc.channels[:2]
    if not (_is_mailbox(receive) and _is_mailbox(send)):
        return False
    if not receive.master_writes or send.master_writes:
        return False
    return receive.end <= send.start or send.end <= receive.start


def check_process_data(esc: Esc, device: Device) -> AlStatusCode:
    """Return the AL status code for process data sync managers that do not fit, or NO_ERROR."""
    for expected in device.process_data.channels:
        channel, size = esc.channels[expected.number], expected.size
        if channel.length != size:
            if expected.is_output:
                return AlStatusCode.OUTPUT_CONFIGURATION
            return AlStatusCode.INPUT_CONFIGURATION
        if size and (
            channel.is_mailbox is not expected.is_single
            or channel.master_writes is not expected.is_output
        ):
            return AlStatusCode.SYNC_MANAGER
        if size and any(_meet(channel, each) for each in esc.channels if each is not channel):
            return AlStatusCode.SYNC_MANAGER
    return AlStatusCode.NO_ERROR


def check_clock(esc: Esc, device: Device) -> AlStatusCode:
    """Return the AL status code for a clock without the required SYNC0, or NO_ERROR."""
    is_requested = esc.memory[Register.DC_ACTIVATION] & 0x02
    if (is_requested or device.needs_sync0) and not esc.clock.sync0_is_active:
        return AlStatusCode.DC_SYNC_CONFIGURATION
    return AlStatusCode.NO_ERROR


def _meet(one: SyncChannel, other: SyncChannel) -> bool:
    """Return true if the buffers of two sync managers overlap."""
    return other.length > 0 and one.start < _end(other) and other.start < _end(one)


def _end(channel: SyncChannel) -> int:
    # The output registers of a controller below its memory have no buffers.
    is_single = channel.is_mailbox or channel.start < Register.MEMORY
    return channel.start + (1 if is_single else _BUFFERS) * channel.length


def _is_mailbox(channel: SyncChannel) -> bool:
    return channel.is_enabled and channel.is_mailbox and channel.length >= MINIMUM_SIZE


OUTPUTS_TIMEOUT_NS = 200_000_000
"""Time-out for the first outputs on the way to OP (ESI default for back to SafeOp)."""

_IDENTIFY = 0x20
_AL_CONTROL, _SM_ACTIVATION = int(AlEvent.AL_CONTROL), int(AlEvent.SM_ACTIVATION)
_SM0 = int(AlEvent.SM0)
_MAILBOX_EVENTS = _SM_ACTIVATION | _SM0 | _SM0 << 1
_WITH_MAILBOX = WITH_MAILBOX | {AlState.BOOT}


class SimulatedSlave:
    """Slave of a simulated segment.

    Attributes:
        esc: Its controller.
        device: Its application.
        is_powered: False while it is switched off; set by :meth:`switch`.
        refused_states: Fault: AL status code of each refused state.
    """

    def __init__(self, esc: Esc, device: Device) -> None:
        self.esc = esc
        self.device = device
        self.is_powered = True
        self.refused_states: dict[AlState, int] = {}
        self._protocols = dict(device.mailbox.protocols) if device.mailbox else {}
        self._reset()

    def _reset(self) -> None:
        self.device.al_state = AlState.INIT
        self._code = 0
        self._awaited: set[int] = set()
        """Sync managers of outputs that have received nothing yet."""
        self._deadline_ns: int | None = None

    @property
    def state(self) -> AlState:
        """Present AL state."""
        return self.device.al_state

    @property
    def code(self) -> int:
        """AL status code; 0 without an error."""
        return self._code

    def switch(self, *, on: bool) -> None:
        """Switch the slave off, or on again with its EEPROM content only."""
        if on and not self.is_powered:
            self.esc.power_on()
            self._reset()
        self.is_powered = on

    def run(self, now_ns: int) -> None:
        """Handle the events of the controller since the last call."""
        event, self.esc.al_event = self.esc.al_event, 0
        if event & _AL_CONTROL:
            self._handle_al_control(now_ns)
        if event & _SM_ACTIVATION:
            self._check_channels()
        if event & _MAILBOX_EVENTS and self._has_mailbox():
            self._serve_mailbox(event)
            self._move_messages(now_ns)
        if event >= _SM0 and self.device.al_state in WITH_PROCESS_DATA:
            self._exchange(now_ns)

    def handle_timeout(self, now_ns: int) -> None:
        """Handle timers: watchdog, time-out of the first outputs, messages of mailbox servers."""
        if not self.is_powered:
            return
        # Called for every slave with each frame: most have nothing to do.
        watchdog = self.esc.watchdog
        expires_ns = watchdog.deadline_ns
        is_over = expires_ns is not None and now_ns >= expires_ns
        if is_over and watchdog.check(now_ns) and self.state is AlState.OP:
            self._stop_outputs()
        if self._deadline_ns is not None and now_ns >= self._deadline_ns:
            self._deadline_ns = None
            self._refuse(AlStatusCode.NO_OUTPUTS)
        if self._has_mailbox():
            self._move_messages(now_ns)
        if (
            self.esc.clock.sync0_is_active
            and self._is_sync_pulse(now_ns)
            and self.state in WITH_PROCESS_DATA
        ):
            self._offer_inputs(now_ns)

    def next_timeout(self) -> int | None:
        """Return the next time for :meth:`handle_timeout`."""
        if not self.is_powered:
            return None
        watchdog_ns, deadline_ns = self.esc.watchdog.deadline_ns, self._deadline_ns
        if watchdog_ns is None or (deadline_ns is not None and deadline_ns < watchdog_ns):
            return deadline_ns
        return watchdog_ns

    def offer_inputs(self, now_ns: int) -> None:
        """Update the input area after a change that no frame caused."""
        if self.is_powered and self.state in WITH_PROCESS_DATA:
            self._offer_inputs(now_ns)

    def _is_sync_pulse(self, now_ns: int) -> bool:
        """Return true if inputs are latched now: by SYNC1 if active, otherwise by SYNC0."""
        clock = self.esc.clock
        sync0 = clock.take_sync0(now_ns)
        return clock.take_sync1(now_ns) > 0 if clock.sync1_is_active else sync0 > 0

    def fail(self, code: int) -> None:
        """Report an application error; in OP the slave falls back to SAFEOP."""
        self._refuse(code)

    def _stop_outputs(self) -> None:
        """Handle the end of the process data watchdog."""
        if not self.esc.emulates_device:
            self.fail(AlStatusCode.WATCHDOG)
            return
        # Without an application the outputs go off, and the state stays.
        for channel in self.device.process_data.active_outputs:
            channel.mapping.unpack(bytes(channel.size))

    def _handle_al_control(self, now_ns: int) -> None:
        at = Register.AL_CONTROL
        control = int.from_bytes(self.esc.memory[at : at + 2], "little")
        requested = control & 0x0F
        if self.esc.emulates_device:
            self._emulate(control)
            return
        # With an error pending, only its acknowledgement or INIT is accepted (ETG.1000.6).
        if self._code and not control & ERROR and requested != AlState.INIT:
            return
        self._code = 0
        self._deadline_ns = None
        try:
            target = AlState(requested)
        except ValueError:
            self._refuse(AlStatusCode.UNKNOWN_STATE)
            return
        if target not in ALLOWED[self.state]:
            self._refuse(AlStatusCode.INVALID_STATE_CHANGE)
            return
        code = self.refused_states.get(target, 0) or self._prepare(target, now_ns)
        if code:
            self._refuse(code)
        elif self._deadline_ns is None:
            self._enter(target)
        # AL status bit 5 says that the AL status code register holds the identification.
        if control & _IDENTIFY and not self._code:
            self.esc.set_al_status(self.state | _IDENTIFY, self.device.identification)

    def _emulate(self, control: int) -> None:
        # The acknowledge bit is mirrored as the error bit, as a controller without application
        # does.
        self.device.al_state = AlState(control & 0x0F) if control & 0x0F in _STATES else self.state
        self.device.process_data.configure()
        self.esc.set_al_status(control & 0x1F, 0)

    def _prepare(self, target: AlState, now_ns: int) -> int:
        """Return the AL status code that forbids *target*; start to wait if outputs are needed."""
        before = self.state
        if before is target:
            return 0
        if before is AlState.INIT:
            return self._start_mailbox(target)
        if before is AlState.PREOP and target is AlState.SAFEOP:
            return self._start_inputs(now_ns)
        if target is AlState.OP:
            code = check_clock(self.esc, self.device)
            # OP needs valid outputs (0x0019 otherwise): the request stays open until the first
            # arrive.
            if not code and self._awaited:
                self._deadline_ns = now_ns + OUTPUTS_TIMEOUT_NS
            return code
        return 0

    def _start_mailbox(self, target: AlState) -> int:
        boot = target is AlState.BOOT
        if boot and not self.device.has_boot:
            return AlStatusCode.BOOT_NOT_SUPPORTED
        mailbox = self.device.mailbox
        if mailbox is None:
            return 0
        if not check_mailbox(self.esc):
            return AlStatusCode.MAILBOX_BOOT if boot else AlStatusCode.MAILBOX_PREOP
        receive, send = self.esc.channels[:2]
        receive.discard()
        send.discard()
        # The present repeat bit is copied without a repetition: nothing was sent yet.
        send.acknowledge_repeat()
        mailbox.protocols = {
            kind: server
            for kind, server in self._protocols.items()
            if kind is MailboxType.FOE or not boot  # in BOOT only FoE runs
        }
        mailbox.start(receive.length, send.length)
        return 0

    def _start_inputs(self, now_ns: int) -> int:
        self.device.process_data.configure()
        code = check_process_data(self.esc, self.device)
        if not code:
            self._await_outputs()
            self._offer_inputs(now_ns)
        return code

    def _await_outputs(self) -> None:
        self._awaited = {each.number for each in self.device.process_data.active_outputs}

    def _enter(self, target: AlState) -> None:
        if target is not AlState.OP:
            self.esc.watchdog.stop()
        self.device.al_state = target
        self.esc.set_al_status(target, self._code)

    def _refuse(self, code: int) -> None:
        # No error leaves a slave in OP: outputs go to their safe state first.
        if self.state is AlState.OP:
            self.device.al_state = AlState.SAFEOP
            self.esc.watchdog.stop()
        self._await_outputs()
        self._code = code
        self.esc.set_al_status(self.state | ERROR, code)

    def _check_channels(self) -> None:
        """Handle a changed sync manager, which is an error while it carries data."""
        if self.esc.emulates_device:
            return
        if self._has_mailbox() and not check_mailbox(self.esc):
            boot = self.state is AlState.BOOT
            self._fall_back(AlState.INIT, AlStatusCode.MAILBOX_BOOT if boot else
                       AlStatusCode.MAILBOX_PREOP)  # fmt: skip
            return
        if self.state in WITH_PROCESS_DATA:
            code = check_process_data(self.esc, self.device)
            if code:
                self._fall_back(AlState.PREOP, code)

    def _fall_back(self, state: AlState, code: int) -> None:
        self.esc.watchdog.stop()
        self._deadline_ns = None
        self.device.al_state = state
        self._refuse(code)

    def _has_mailbox(self) -> bool:
        return self.device.mailbox is not None and self.state in _WITH_MAILBOX

    def _serve_mailbox(self, event: int) -> None:
        mailbox = self.device.mailbox
        send = self.esc.channels[1]
        assert mailbox is not None  # noqa: S101  checked by the caller
        if event & send.event and not send.is_full:
            mailbox.handle_read()
        if send.repeat_request != send.repeat_acknowledge:
            again = mailbox.repeat_message()
            if again is not None:
                send.discard()
                send.put(again)
            send.acknowledge_repeat()

    def _move_messages(self, now_ns: int) -> None:
        mailbox = self.device.mailbox
        receive, send = self.esc.channels[:2]
        assert mailbox is not None  # noqa: S101  checked by the caller
        if mailbox.is_ready:
            request = receive.take()
            if request is not None:
                mailbox.receive_message(request, now_ns)
        if not send.is_full:
            message = mailbox.next_message(now_ns)
            if message is not None:
                send.put(message)

    def _exchange(self, now_ns: int) -> None:
        for channel in self.device.process_data.active_outputs:
            data = self.esc.channels[channel.number].take()
            if data is None:
                continue
            self._awaited.discard(channel.number)
            # The first outputs complete the request of OP.
            if self._deadline_ns is not None and not self._awaited:
                self._deadline_ns = None
                self._enter(AlState.OP)
            # In SAFEOP outputs are received, as proof that they arrive, but not applied.
            if self.state is AlState.OP:
                channel.mapping.unpack(data)
        self._offer_inputs(now_ns)

    def _offer_inputs(self, now_ns: int) -> None:
        device = self.device
        device.step(now_ns)
        for channel in device.process_data.active_inputs:
            self.esc.channels[channel.number].put(channel.mapping.pack())


_STATES = frozenset(AlState)
