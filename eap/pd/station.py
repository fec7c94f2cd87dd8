"""One station: its process image, its ports, and the steps of its cycle.

This module alone defines the order within a cycle: receive all pending frames, of other stations
and of buses; apply time-outs; copy the inputs of the last exchange of each bus; compute generated
variables; copy the variables that services and applications wrote; run the links; select the PDs
that are due, patch their frames and send them; send the outputs of each bus, which starts its next
exchange.  The engine's region is marked as changing from the first frame to the last link, so
that a reader sees inputs and what follows from them in one cycle.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from functools import partial
from types import MappingProxyType

import msgspec

from eap.pd.address import NetIdLearner, forget
from eap.pd.device import DeviceState, EapDevice
from eap.pd.image import Image, Inputs, Sampler
from eap.pd.link import CyclicBus, FrameChannel, FrameHandler, PortTap, StateChannel
from eap.pd.links import Generators, Links
from eap.pd.poll import outgoing_polls, requests_at
from eap.pd.publisher import FrameRow, PollResponder, Publisher
from eap.pd.quality import find_origins
from eap.pd.spec import EngineSource, LengthCheck, PortKind, StationSpec, Writer
from eap.pd.subscriber import Subscriber
from eap.pd.words import BIN_OF_US, StationWord, histogram_bin

_CYCLE = int(StationWord.CYCLE)
_CYCLE_AT_NS = int(StationWord.CYCLE_AT_NS)
_STARTED_AT_NS = int(StationWord.STARTED_AT_NS)
_SEQUENCE = int(StationWord.ENGINE_SEQUENCE)
_FUTEX = int(StationWord.FUTEX)
_WAITERS = int(StationWord.WAITERS)
_OVERRUNS = int(StationWord.OVERRUNS)
_LATENESS = int(StationWord.LATENESS)
_BINS_KNOWN = len(BIN_OF_US)
_LATENESS_MAX_NS = int(StationWord.LATENESS_MAX_NS)

WAKE_FOR_CYCLES = 100
"""Cycles after the last announcement of a waiting program in which waiters are woken."""

_UNREAD_FOR_US = 10_000
"""Interval of draining a port without subscriptions, whose frames are only counted."""


class Station:
    """Runs the cycle of one station.

    Build it, hand :attr:`handlers` to the channels, :meth:`connect` them and its buses, then
    :meth:`start`.

    Args:
        spec: The checked specification.
        image: Its process image, fresh or left by an earlier engine of the same layout.
        wake: Wakes the programs that wait for the next cycle.

    Attributes:
        buses: Those that take part in its cycle.
        handlers: Handlers of received frames, by port.
    """

    def __init__(self, spec: StationSpec, image: Image, wake: Callable[[], None]) -> None:
        self.spec = spec
        self.image = image
        self.cycle_ns = spec.cycle_us * 1000
        self.step_ns = self.cycle_ns
        """Distance to the next cycle: another one where the station follows a clock of a bus."""
        self.device = EapDevice()
        self._words = image.words
        self._wake = wake
        self._inputs = Inputs(image)
        self._samples = Sampler(image, self._inputs.memory)
        generated = [s for s in spec.sources if isinstance(s, EngineSource)]
        self._generate = Generators(image, generated).run
        self._run_links = Links(image, self.memory_of, spec.links).run if spec.links else None
        self._computes = bool(generated or spec.links)
        """True if variables are computed in the cycle."""
        self._has_own_variables = self._computes
        self._origins = find_origins(image.layout, spec.links)
        self.buses: list[CyclicBus] = []
        self._publishers: list[tuple[Publisher | PollResponder, FrameChannel]] = []
        self._sending: list[tuple[Publisher | PollResponder, FrameChannel]] = []
        """The publishers, in states that send."""
        self._senders: list[tuple[str, Publisher | PollResponder, FrameChannel]] = []
        """The publishers with their ports, and the channels without taps."""
        self._taps: dict[str, tuple[PortTap, FrameHandler]] = {}
        """Taps by port, each with the handler that is behind it."""
        self._ports: dict[str, tuple[FrameChannel, Publisher | None]] = {}
        self._channels: list[FrameChannel] = []
        self._drains: list[Callable[[int], object]] = []
        self._rarely: list[Callable[[int], int]] = []
        self._rarely_every = max(1, _UNREAD_FOR_US // spec.cycle_us)
        self._requests = {port.name: requests_at(spec, port.name) for port in spec.ports}
        self._polls = outgoing_polls(image)
        self._closing: list[Callable[[int], None]] = [q.look for q in self._polls.values()]
        """Steps at the end of a cycle, after everything has been sent to other stations."""
        self._subscribers = {
            port.name: self._subscriber(port.name)
            for port in spec.ports
            if port.kind is PortKind.EAP
        }
        self._supervisors: list[Callable[[int], None]] = [
            subscriber.handle_timeout
            for subscriber in self._subscribers.values()
            if subscriber.has_timeouts
        ]
        self.handlers: dict[str, FrameHandler] = {
            name: subscriber.receive_frame for name, subscriber in self._subscribers.items()
        }
        self._learners = {port: NetIdLearner(self.handlers[port]) for port in _learning_ports(spec)}
        self.handlers.update((port, learner.handle) for port, learner in self._learners.items())

    def _subscriber(self, port: str) -> Subscriber:
        rows = zip(self.spec.subscriptions, self.image.layout.rx, strict=True)
        own = [(pd, slot) for pd, slot in rows if pd.port == port]
        lenient = any(p.name == port and p.length is LengthCheck.LENIENT for p in self.spec.ports)
        return Subscriber(
            self.image, own, self.cycle_ns, self._requests[port], self._polls, lenient=lenient
        )

    def connect(self, port: str, channel: FrameChannel) -> None:
        """Send the frames of *port* through *channel*, and drain it.

        That is done in each cycle, or now and then if nothing is subscribed to there.
        """
        layout = self.image.layout
        frames = [
            (frame, slot, tuple(pd for pd in layout.tx if pd.frame == frame.name))
            for frame, slot in zip(self.spec.frames, layout.frames, strict=True)
            if frame.port == port
        ]
        if any(pd.port == port for pd in self.spec.subscriptions):
            self.drain_also(channel)
        else:
            self._rarely.append(channel.drain)
        own = next(p for p in self.spec.ports if p.name == port)
        net_id = own.net_id
        out = StateChannel(channel, self._words) if own.eap_sm else channel
        publisher = None
        if pushed := _pds_of(frames, polled=False):
            publisher = Publisher(self.image, self._inputs, net_id, out, pushed, self._origins)
            self._senders.append((port, publisher, out))
        if polled := _pds_of(frames, polled=True):
            requests = self._requests[port]
            answerer = PollResponder(
                self.image, self._inputs, net_id, out, polled, requests, self._origins
            )
            self._senders.append((port, answerer, out))
        self._connect_senders()
        self._ports[port] = channel, publisher
        self._teach(port)

    def _teach(self, port: str) -> None:
        """Have the publisher of *port* learn the addresses of its NetIDs."""
        publisher = self._ports[port][1]
        if learner := self._learners.get(port):
            learner.wanted = () if publisher is None else publisher.wanted
            learner.learn = forget if publisher is None else publisher.learn

    def _connect_senders(self) -> None:
        """Have the publishers send through their channels, or through the taps of their ports."""
        # In place: the list of those that send is the same one, or empty.
        self._publishers[:] = [
            (publisher, self._taps[port][0].sending(channel) if port in self._taps else channel)
            for port, publisher, channel in self._senders
        ]

    @property
    def untapped_ports(self) -> Collection[str]:
        """The ports that have a channel and no tap."""
        return self._ports.keys() - self._taps.keys()

    def tap(self, port: str, tap: PortTap) -> None:
        """Have *tap* observe all frames of *port*, between two cycles, until :meth:`untap`."""
        if port in self._taps:
            return
        plain = self.handlers[port]
        self._taps[port] = tap, plain
        self._exchange_handler(port, plain, tap.received(plain))
        self._connect_senders()

    def untap(self) -> None:
        """Remove all taps."""
        for port, (_, plain) in self._taps.items():
            self._exchange_handler(port, self.handlers[port], plain)
        self._taps.clear()
        self._connect_senders()

    def _exchange_handler(self, port: str, old: FrameHandler, new: FrameHandler) -> None:
        self.handlers[port] = new
        for channel in (*(each for each, _ in self._ports.values()), *self._channels):
            channel.exchange_handler(old, new)

    def drain_also(self, channel: FrameChannel) -> None:
        """Drain another channel that feeds this station, such as a multicast group."""
        # Two ports may share an interface: drained once, its frames go to the handlers of both.
        if channel not in self._channels:
            self._channels.append(channel)
            self._drains.append(channel.drain)
            self._has_own_variables = True

    def connect_bus(self, bus: CyclicBus) -> None:
        """Exchange process data with *bus* in each cycle."""
        self.buses.append(bus)
        self._drains.append(bus.receive)
        self._supervisors.append(partial(_supervise, bus))
        self._closing.append(bus.exchange)
        self._has_own_variables = True

    def memory_of(self, writer: Writer) -> memoryview:
        """Return where the cycle reads the variables of *writer*, at their offsets in the image.

        What the engine does not write itself is a copy that does not change within a cycle.
        """
        return self.image.memory if writer is Writer.ENGINE else self._inputs.memory

    def start(self, now_ns: int, state: DeviceState = DeviceState.OP) -> int:
        """Go to *state*; return when the first cycle is due.

        The cycle counter of an earlier engine continues as if it had never stopped.
        """
        words = self._words
        self._enter(state)
        words[_STARTED_AT_NS] = now_ns
        words[_SEQUENCE] += words[_SEQUENCE] % 2  # a killed engine may have left it odd
        if state.receives:
            for subscriber in self._subscribers.values():
                subscriber.open(now_ns)
        self._wake()  # who sleeps since before a restart would be too far behind to count
        previous_ns = words[_CYCLE_AT_NS]
        if 0 < previous_ns <= now_ns:
            words[StationWord.RESTARTS] += 1
            elapsed = (now_ns - previous_ns) // self.cycle_ns
            # The counter follows the time: receivers see missing frames, not a restarted sender.
            words[_CYCLE] += elapsed
            words[_FUTEX] = words[_CYCLE] & 0xFFFFFFFF  # no cycle is under way
            return int(previous_ns + (elapsed + 1) * self.cycle_ns)
        words[_CYCLE_AT_NS] = 0  # of a time before the host was booted
        phase_ns = self.spec.phase_us * 1000
        # All stations start on one grid, so that their phases stagger them.
        grid_ns = now_ns - now_ns % self.cycle_ns + phase_ns
        return grid_ns if grid_ns > now_ns else grid_ns + self.cycle_ns

    @property
    def inputs(self) -> Inputs:
        """The variables of others as its cycle sees them."""
        return self._inputs

    @property
    def has_run(self) -> bool:
        """True if a cycle has run since :meth:`start`."""
        return bool(self._words[_CYCLE_AT_NS] > self._words[_STARTED_AT_NS])

    def go(self, state: DeviceState, now_ns: int) -> None:
        """Go to another state while cycles run; raise LocalProtocolError if there is no way."""
        before = self.device.state
        self._enter(state)
        for subscriber in self._subscribers.values():
            if before.receives and not state.receives:
                subscriber.close()
            elif state.receives and not before.receives:
                subscriber.resume(now_ns)
        for _, publisher in self._ports.values():
            if publisher is not None and state.sends and not before.sends:
                publisher.forget()

    def stop(self) -> None:
        """Stop receiving and sending."""
        self._enter(DeviceState.PREOP)
        for subscriber in self._subscribers.values():
            subscriber.close()

    def _enter(self, state: DeviceState) -> None:
        self.device.go(state)
        self._words[StationWord.STATE] = state
        self._sending = self._publishers if state.sends else []
        if not state.receives:
            for requests in self._requests.values():
                requests.pop_all()

    def channel(self, port: str) -> FrameChannel:
        """Return the channel of *port*."""
        return self._ports[port][0]

    def prepare_handover(
        self, before: Station, channels: Mapping[str, FrameChannel] = MappingProxyType({})
    ) -> None:
        """Connect like *before*, or to *channels*, and learn the frames that it receives.

        All slow work is done here, while *before* runs; it is only read.
        """
        for port, (channel, was) in before._ports.items():
            self.connect(port, channels.get(port, channel))
            publisher = self._ports[port][1]
            if publisher is not None and was is not None:
                publisher.learn_from(was)
        fed = [channel for channel, _ in (*before._ports.values(), *self._ports.values())]
        for channel in before._channels:
            if channel not in fed:
                self.drain_also(channel)
        for bus in before.buses:
            self.connect_bus(bus)
        for port, subscriber in self._subscribers.items():
            subscriber.learn_from(before._subscribers[port])

    def follow(self, before: Station, now_ns: int) -> None:
        """Take the place of *before* between two of its cycles.

        The image already holds the content of the other.  Channels keep the handlers of *before*.
        """
        self._inputs.reload()
        replaced = [subscriber.handle_timeout for subscriber in self._subscribers.values()]
        self._supervisors = [each for each in self._supervisors if each not in replaced]
        for port, subscriber in before._subscribers.items():
            # The object stays and gets the parts of the new one: channels hold its bound method.
            subscriber.swap_in(self._subscribers[port], now_ns)
            if subscriber.has_timeouts:
                self._supervisors.append(subscriber.handle_timeout)
        self._subscribers, before._subscribers = before._subscribers, self._subscribers
        self.handlers = before.handlers
        self._taps = before._taps
        self._connect_senders()
        self._learners = before._learners
        for port, requests in self._requests.items():
            requests.follow(before._requests[port])
        for name in self._polls.keys() & before._polls.keys():
            self._polls[name].follow(before._polls[name])
        for port, (_, publisher) in self._ports.items():
            was = before._ports[port][1]
            if publisher is not None and was is not None:
                publisher.follow(was)
            self._teach(port)
        self._enter(before.device.state)

    def release(self) -> None:
        """Free all parts one by one, after another station has taken over."""
        for _, publisher in self._ports.values():
            if publisher is not None:
                publisher.release()
        for subscriber in self._subscribers.values():
            subscriber.release()
        self.image.release()

    def cycle(self, due_ns: int, now_ns: int) -> None:
        """Run one cycle that was due at *due_ns*."""
        words = self._words
        cycle = words[_CYCLE] + 1
        words[_CYCLE] = cycle  # one by one: pack_into would show readers a 0 in between
        words[_CYCLE_AT_NS] = due_ns
        if self._has_own_variables or not cycle % self._rarely_every:
            changed = self._write_own_variables(cycle, now_ns)
        else:
            changed = self._inputs.refresh()
        if changed:
            for publisher, _ in self._publishers:
                publisher.read_controls()
        for publisher, channel in self._sending:
            frames = publisher.frames_to_send(cycle, now_ns)
            if frames:
                publisher.sent(channel.send(frames, now_ns), now_ns)
        if self._closing:
            for close in self._closing:
                close(now_ns)
        late_ns = now_ns - due_ns
        late_us = late_ns // 1000
        bin_ = BIN_OF_US[late_us] if 0 <= late_us < _BINS_KNOWN else histogram_bin(late_us)
        words[_LATENESS + bin_] += 1
        if late_ns > words[_LATENESS_MAX_NS]:  # noqa: PLR1730  max() takes five times as long
            words[_LATENESS_MAX_NS] = late_ns
        self._samples.end_cycle(cycle, now_ns)
        words[_FUTEX] = cycle & 0xFFFFFFFF
        # Never cleared here: a program that comes between the look and the clearing would sleep on.
        if cycle - words[_WAITERS] <= WAKE_FOR_CYCLES:
            self._wake()

    def _write_own_variables(self, cycle: int, now_ns: int) -> bool:
        """Write the engine's region; return whether services or applications wrote something."""
        words = self._words
        sequence = words[_SEQUENCE]
        # Odd for the whole block, so that a reader sees inputs and their results in one cycle.
        words[_SEQUENCE] = sequence + 1
        for drain in self._drains:
            drain(now_ns)
        if self._rarely and not cycle % self._rarely_every:
            for drain in self._rarely:
                drain(now_ns)
        for supervise in self._supervisors:
            supervise(now_ns)
        if self._computes:
            # Skipped cycles count: a generated value follows the time and not the number of runs.
            self._generate(cycle + words[_OVERRUNS])
            changed = self._inputs.refresh()
            if self._run_links is not None:
                self._run_links()
        else:
            changed = self._inputs.refresh()
        words[_SEQUENCE] = sequence + 2
        return changed


def _learning_ports(spec: StationSpec) -> Iterator[str]:
    """Yield the ports from which a frame may go to a NetID, now or after a reconfiguration."""
    for port in spec.ports:
        is_ethernet = port.interface.scheme == "ethernet"
        if port.kind is PortKind.EAP and is_ethernet:
            yield port.name


def _supervise(bus: CyclicBus, now_ns: int) -> None:
    """Run the timers of *bus* if the cycle has kept them waiting, then take its inputs."""
    due_ns = bus.next_timeout()
    if due_ns is not None and due_ns <= now_ns:
        bus.handle_timeout(now_ns)
    bus.copy_inputs()


def _pds_of(frames: Iterable[FrameRow], *, polled: bool) -> list[FrameRow]:
    """Return the frames with those of their PDs that are polled, or those that are not."""
    rows: list[FrameRow] = []
    for spec, slot, slots in frames:
        kept = [index for index, pd in enumerate(spec.pds) if bool(pd.poll_request) is polled]
        if kept:
            pds = tuple(spec.pds[index] for index in kept)
            own = msgspec.structs.replace(spec, pds=pds)
            rows.append((own, slot, tuple(slots[index] for index in kept)))
    return rows
