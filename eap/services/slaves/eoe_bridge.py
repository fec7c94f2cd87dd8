"""EoE of one bus: the switch between a TAP interface of the host and the mailboxes of slaves.

Rule 1: a slave is connected while its mailbox is open in PREOP, SAFEOP or OP.  Its IP settings of
the plant file are written each time that this begins, because a slave may forget them.
Rule 2: a frame is one conversation with the mailbox.  It waits behind other EoE conversations with
that slave only; the engine alternates protocols message by message, so SDOs go on beside it.
Rule 3: without the TAP interface the slaves still reach each other.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterator
from contextlib import suppress
from ipaddress import IPv4Address, IPv4Interface
from time import monotonic_ns

from devicebus.errors import EoeError
from devicebus.mailbox.eoe import FrameAssembler, set_ip
from devicebus.mailbox.eoe_switch import HOST, EthernetSwitch, send_frame
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.master.mailboxes import Unsolicited
from devicebus.wire.alstatus import AlState
from devicebus.wire.sii import SiiProtocol
from eap.codec.eoe import EoeHeader, EoeType, IpSettings
from eap.codec.mailbox import MailboxType
from eap.errors import CodecError, EapError, EnvironmentalError
from eap.ids import MacAddr
from eap.net.tap import TapPort
from eap.pd.spec import EoeSlaveSpec, EoeSpec
from eap.runtime.engine_messages import EoePortReport, EoeReport, SlaveDescription
from eap.services.slaves.bus_client import BusClient
from eap.services.tasks import TaskSet

OPEN_RETRY_S = 2.0
"""Pause before the interface is opened again."""
FOLLOW_S = 1.0
"""Interval at which the description of the bus is confirmed."""
SETTINGS_TRIES = 3
SETTINGS_PAUSE_S = 2.0
"""Pause before settings are written again to a slave that did not answer."""
FAILURE_PAUSE_S = 0.1
"""Pause after a frame that a slave did not take."""
_CONNECTED = frozenset((AlState.PREOP, AlState.SAFEOP, AlState.OP))

logger = logging.getLogger(__name__)


class _SlaveLink:
    """One slave at the switch.

    Attributes:
        wake: Set when the switch has a frame for it.
        occasion: Differs when the slave has left its state meanwhile.
        ip: Address that the slave has accepted.
        fault: Reason that its settings were not written.
    """

    def __init__(self, slave: SlaveDescription, settings: IpSettings | None) -> None:
        self.slave = slave
        self.settings = settings
        self.wake = asyncio.Event()
        self.assembler = FrameAssembler()
        self.occasion: tuple[int, ...] | None = None
        self.task: asyncio.Task[None] | None = None
        self.ip = self.fault = self.last_error = ""
        self.failed = 0

    @property
    def station(self) -> int:
        """Station address."""
        return self.slave.station


def _occasion(slave: SlaveDescription) -> tuple[int, ...] | None:
    """Return a value that changes when a slave begins anew, None while it is not connected."""
    if not slave.to_slave or slave.state not in _CONNECTED:
        return None
    return slave.losses, slave.departures, slave.to_slave


def settings_of(slave: SlaveDescription, spec: EoeSlaveSpec) -> IpSettings | None:
    """Return the settings of the plant file for a slave, None if it has none."""
    if not spec.ip:
        return None
    interface = IPv4Interface(spec.ip)
    return IpSettings(
        MacAddr.parse(spec.mac) if spec.mac else default_mac(slave.station),
        interface.ip,
        interface.netmask,
        _address(spec.gateway),
        _address(spec.dns),
        spec.name or None,
    )


def _address(text: str) -> IPv4Address | None:
    return IPv4Address(text) if text else None


def default_mac(station: int) -> MacAddr:
    """Return the MAC address of a slave without one in the plant file, as TwinCAT gives it."""
    return MacAddr(bytes.fromhex("02010530") + station.to_bytes(2))


class EoeBridge:
    """The switch of one bus port.

    Args:
        bus: With the slaves.
        spec: Interface, address, and slaves.
        open_tap: Opens the interface.
    """

    def __init__(
        self,
        bus: BusClient,
        spec: EoeSpec,
        open_tap: Callable[[str, IPv4Interface | None], TapPort] = TapPort,
    ) -> None:
        self._bus = bus
        self._spec = spec
        self._open_tap = open_tap
        self._address = IPv4Interface(spec.address) if spec.address else None
        self._switch = EthernetSwitch(self._notify)
        self._links: dict[int, _SlaveLink] = {}
        self._tap: TapPort | None = None
        self._fault = "the interface is not open yet"
        self._tasks = TaskSet(f"EoE of {bus.name}")
        bus.listen(self._receive)
        bus.view.on_change.append(self._update)

    async def serve(self) -> None:
        """Connect host and slaves until cancelled."""
        self._tasks.start(self._follow())
        try:
            while True:
                try:
                    tap = self._open_tap(self._spec.interface, self._address)
                except EnvironmentalError as exc:
                    self._fail(str(exc))
                else:
                    await self._use(tap)
                await asyncio.sleep(OPEN_RETRY_S)
        finally:
            await self._tasks.close()

    async def _follow(self) -> None:
        """Keep the description of the bus complete: a new process gets only what changes."""
        while True:
            with suppress(EapError):  # no engine, which will say so itself when it is back
                await self._bus.view.current()
            self._update()
            await asyncio.sleep(FOLLOW_S)

    def report(self) -> EoeReport:
        """Return counters and reasons."""
        host, now_ns = self._switch.counters(HOST), monotonic_ns()
        return EoeReport(
            interface=self._spec.interface,
            address=self._spec.address,
            fault=self._fault or self._describe_link(),
            received=host.received,
            sent=host.sent,
            dropped=host.dropped + (self._tap.dropped if self._tap is not None else 0),
            slaves=(
                *(self._port_report(link, now_ns) for link in self._links.values()),
                *self._unsupported(),
            ),
        )

    def _describe_link(self) -> str:
        """Return why an open interface carries nothing; empty if it does."""
        if self._tap is None or self._tap.is_up():
            return ""
        name = self._tap.name
        return f"TAP interface {name} is down: `ip link set {name} up` as root switches it on"

    def _port_report(self, link: _SlaveLink, now_ns: int) -> EoePortReport:
        counters = self._switch.counters(link.station)
        return EoePortReport(
            station=link.station,
            name=link.slave.name,
            is_connected=link.task is not None,
            ip=link.ip,
            fault=link.fault,
            received=counters.received,
            sent=counters.sent,
            dropped=counters.dropped,
            invalid=counters.invalid,
            failed=link.failed,
            last_error=link.last_error,
            addresses=tuple(
                str(MacAddr(mac)) for mac in self._switch.addresses(link.station, now_ns)
            ),
        )

    def _unsupported(self) -> Iterator[EoePortReport]:
        """Yield the slaves of the plant file that have no EoE."""
        for slave in self._bus.view.latest.slaves.values():
            names = {slave.name, str(slave.station)}
            is_wanted = any(each.slave in names for each in self._spec.slaves)
            if is_wanted and slave.state and not slave.protocols & SiiProtocol.EOE:
                fault = "the slave does not support EoE: remove it from the plant file"
                yield EoePortReport(station=slave.station, name=slave.name, fault=fault)

    def _fail(self, reason: str) -> None:
        if reason != self._fault:
            logger.warning("%s: EoE: %s", self._bus.name, reason)
        self._fault = reason

    async def _use(self, tap: TapPort) -> None:
        """Exchange frames with the host until the interface is gone."""
        loop = asyncio.get_running_loop()
        is_gone = asyncio.Event()

        def read() -> None:
            try:
                for frame in tap.read_frames():
                    self._switch.receive_frame(HOST, frame, monotonic_ns())
            except OSError as exc:
                self._fail(f"TAP interface {tap.name} is gone or down: {exc.strerror}")
                # An interface without a reader would be reported as readable for ever.
                loop.remove_reader(tap.fileno())
                is_gone.set()

        self._tap, self._fault = tap, ""
        self._switch.connect(HOST)
        loop.add_reader(tap.fileno(), read)
        logger.info("%s: EoE at TAP interface %s", self._bus.name, tap.name)
        try:
            await is_gone.wait()
        finally:
            loop.remove_reader(tap.fileno())
            self._switch.disconnect(HOST)
            self._tap = None
            tap.close()

    def _notify(self, port: int) -> None:
        """Send what the switch has for a port."""
        if port != HOST:
            self._links[port].wake.set()
            return
        while (frame := self._switch.take_frame(HOST)) is not None:
            if self._tap is not None:
                self._tap.write_frame(frame)

    def _receive(self, message: Unsolicited) -> None:
        """Take a fragment of a slave's frame."""
        link = self._links.get(message.station)
        if link is None or message.type is not MailboxType.EOE:
            return
        before, frame = link.assembler.dropped, None
        try:
            if EoeHeader.decode(message.data).type is EoeType.FRAGMENT:
                frame = link.assembler.receive(message.data)
        except CodecError:
            self._switch.count_invalid(message.station)
        if missing := link.assembler.dropped - before:
            self._switch.count_invalid(message.station, missing)
        if frame is not None:
            self._switch.receive_frame(message.station, frame, monotonic_ns())

    def _update(self) -> None:
        """Connect the slaves that have come, and disconnect those that have gone."""
        slaves = self._bus.view.latest.slaves
        for station, slave in slaves.items():
            spec = self._spec_of(slave)
            if spec is None:
                continue
            link = self._links.get(station)
            if link is None:
                link = self._links[station] = _SlaveLink(slave, settings_of(slave, spec))
            occasion = _occasion(slave)
            if occasion != link.occasion:
                self._stop(link)
                link.slave, link.occasion = slave, occasion
                if occasion is not None:
                    self._start(link)
        for link in self._links.values():
            if link.station not in slaves:
                self._stop(link)
                link.occasion = None

    def _spec_of(self, slave: SlaveDescription) -> EoeSlaveSpec | None:
        """Return the settings of a slave that is connected, None for any other slave."""
        if not slave.protocols & SiiProtocol.EOE:
            return None
        names = {slave.name, str(slave.station)}
        default = EoeSlaveSpec(slave.name) if self._spec.connects_all else None
        return next((each for each in self._spec.slaves if each.slave in names), default)

    def _start(self, link: _SlaveLink) -> None:
        link.assembler.reset()
        link.ip = link.fault = ""
        self._switch.connect(link.station)
        link.task = self._tasks.start(self._serve_link(link))

    def _stop(self, link: _SlaveLink) -> None:
        self._switch.disconnect(link.station)
        task, link.task = link.task, None
        if task is not None:
            task.cancel()

    async def _serve_link(self, link: _SlaveLink) -> None:
        """Write the settings of a slave, then send its frames until cancelled."""
        if link.settings is not None:
            await self._write_settings(link, link.settings)
        sizes = MailboxSizes(link.slave.to_slave, link.slave.to_master)
        number = 0
        while True:
            link.wake.clear()
            frame = self._switch.take_frame(link.station)
            if frame is None:
                await link.wake.wait()
                continue
            try:
                await self._bus.converse(link.station, send_frame(frame, number, sizes), self)
            except EapError as exc:
                link.failed += 1
                link.last_error = str(exc)
                await asyncio.sleep(FAILURE_PAUSE_S)
            number = (number + 1) % 16

    async def _write_settings(self, link: _SlaveLink, settings: IpSettings) -> None:
        """Write the settings of a slave; one that does not answer gets them again."""
        for _ in range(SETTINGS_TRIES):
            try:
                await self._bus.converse(link.station, set_ip(settings), self)
            except EapError as exc:
                link.fault = f"IP settings: {exc}"
                if isinstance(exc, EoeError):
                    break  # its answer stays the same
                await asyncio.sleep(SETTINGS_PAUSE_S)
            else:
                link.ip, link.fault = str(settings.ip), ""
                return
        logger.warning("%s/%s: %s", self._bus.name, link.slave.name, link.fault)
