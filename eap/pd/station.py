"""One station: its process image, its ports, and the steps of its cycle.

This module alone defines the order within a cycle: receive all pending frames, of other stations
and of buses; apply time-outs; copy the inputs of the last exchange of each bus; compute generated
variables; copy the variables that services and applications wrote; run the links; select the PDs
that are due, patch their frames and send them; send the outputs of each bus, which starts its next
exchange.  The engine's region is marked as changing from the first frame to the last link, so
that a reader sees inputs and what follows from them in one cycle.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import NamedTuple, TypeAlias

import msgspec

from eap.compiled import override
from eap.pd import ordering
from eap.pd.address import NetIdLearner, forget
from eap.pd.authentication import KeyRing, SigningChannel
from eap.pd.compiledplan import compile_cycle
from eap.pd.device import DeviceState, EapDevice
from eap.pd.image import Image, Inputs, Sampler
from eap.pd.link import CyclicBus, FrameChannel, FrameHandler, PortTap, StateChannel
from eap.pd.links import Generators, Links
from eap.pd.poll import outgoing_polls, requests_at
from eap.pd.publisher import FrameRow, PollResponder, Publisher
from eap.pd.quality import find_origins
from eap.pd.spec import EngineSource, LengthCheck, PortKind, StationSpec, Writer
from eap.pd.subscriber import NO_KEYS, Subscriber
from eap.pd.words import BIN_OF_US, WAKE_FOR_CYCLES, StationWord, histogram_bin

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

_UNREAD_FOR_US = 10_000
"""Interval of draining a port without subscriptions, whose frames are only counted."""


class _ConnectedPort(NamedTuple):
    """An EAP port with its channels."""

    channel: FrameChannel
    publisher: Publisher | None
    groups: tuple[FrameChannel, ...]


_Outlet: TypeAlias = tuple[Publisher | PollResponder, FrameChannel, object, object]
"""A publisher and its channel; what the compiled part has of both, None without it."""


class Station:
    """Runs the cycle of one station.

    Build it, hand :attr:`handlers` to the channels, :meth:`connect` them and its buses, then
    :meth:`start`.

    Args:
        spec: The checked specification.
        image: Its process image, fresh or left by an earlier engine of the same layout.
        wake: Wakes the programs that wait for the next cycle.
        keys: Keys of signed frames.

    Attributes:
        buses: Those that take part in its cycle.
        handlers: Handlers of received frames, by port.
    """

    def __init__(
        self, spec: StationSpec, image: Image, wake: Callable[[], None], keys: KeyRing = NO_KEYS
    ) -> None:
        self.spec = spec
        self.keys = keys
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
        self._origins = find_origins(image.layout, spec.links)
        self.buses: list[CyclicBus] = []
        self._outlets: list[_Outlet] = []
        self._sends = False
        self._senders: list[tuple[str, Publisher | PollResponder, FrameChannel]] = []
        """The publishers with their ports, and the channels without taps."""
        self._taps: dict[str, tuple[PortTap, FrameHandler]] = {}
        """Taps by port, each with the handler that is behind it."""
        self._ports: dict[str, _ConnectedPort] = {}
        self._added: frozenset[str] = frozenset()
        """Ports without a predecessor in the station before this one."""
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
        self._learners = {
            port: NetIdLearner(self._subscribers[port].receive_frame)
            for port in _learning_ports(spec)
        }
        self.handlers: dict[str, FrameHandler] = {
            name: subscriber.make_handler(self._learners.get(name))
            for name, subscriber in self._subscribers.items()
        }
        # Its parts and not this object, which refers to it.
        self._compiled = compile_cycle(
            image.words,
            self._rarely_every,
            self._generate if self._computes else None,
            self._run_links,
            self._inputs.refresh,
            partial(_read_controls, self._outlets),
            self._samples.end_cycle,
            wake,
        )
        if self._compiled is not None:
            override(self, "cycle", self._compiled.run)
        self._attach()

    def _subscriber(self, port: str) -> Subscriber:
        rows = zip(self.spec.subscriptions, self.image.layout.rx, strict=True)
        own = [(pd, slot) for pd, slot in rows if pd.port == port]
        lenient = any(p.name == port and p.length is LengthCheck.LENIENT for p in self.spec.ports)
        return Subscriber(
            self.image,
            own,
            self.cycle_ns,
            self._requests[port],
            self._polls,
            lenient=lenient,
            keys=self.keys,
        )

    def connect(
        self, port: str, channel: FrameChannel, groups: Sequence[FrameChannel] = ()
    ) -> None:
        """Send the frames of *port* through *channel*, and drain it and *groups*.

        That is done in each cycle; *channel* is drained now and then if nothing is subscribed to
        there.  *groups* are further channels that feed the port, such as multicast groups.
        """
        layout = self.image.layout
        frames = [
            (frame, slot, tuple(pd for pd in layout.tx if pd.frame == frame.name))
            for frame, slot in zip(self.spec.frames, layout.frames, strict=True)
            if frame.port == port
        ]
        if any(pd.port == port for pd in self.spec.subscriptions):
            self._drain(channel)
        else:
            self._rarely.append(channel.drain)
        for group in groups:
            self._drain(group)
        own = next(p for p in self.spec.ports if p.name == port)
        net_id = own.net_id
        out: FrameChannel = channel
        if any(frame.sign for frame, _, _ in frames):
            out = SigningChannel(out, self.keys)
        if own.eap_sm:
            out = StateChannel(out, self._words)
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
        self._ports[port] = _ConnectedPort(channel, publisher, tuple(groups))
        self._teach(port)

    def _teach(self, port: str) -> None:
        """Have the publisher of *port* learn the addresses of its NetIDs."""
        publisher = self._ports[port].publisher
        if learner := self._learners.get(port):
            learner.wanted = () if publisher is None else publisher.wanted
            learner.learn = forget if publisher is None else publisher.learn

    def _connect_senders(self) -> None:
        """Have the publishers send through their channels, or through the taps of their ports."""
        self._outlets.clear()
        for port, publisher, channel in self._senders:
            out = self._taps[port][0].sending(channel) if port in self._taps else channel
            self._outlets.append((publisher, out, publisher.plan, out.direct))
        self._attach()

    def _attach(self) -> None:
        """Have the compiled cycle go through the present steps."""
        if self._compiled is not None:
            self._compiled.attach(
                self._drains, self._rarely, self._supervisors, self._closing, self._outlets
            )

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

    def untap(self, ports: Collection[str] | None = None) -> None:
        """Remove the taps of *ports*, or all."""
        for port in self._taps.keys() & (self._taps.keys() if ports is None else set(ports)):
            _, plain = self._taps.pop(port)
            self._exchange_handler(port, self.handlers[port], plain)
        self._connect_senders()

    def _exchange_handler(self, port: str, old: FrameHandler, new: FrameHandler) -> None:
        self.handlers[port] = new
        for channel in (*(each.channel for each in self._ports.values()), *self._channels):
            channel.exchange_handler(old, new)

    def _drain(self, channel: FrameChannel) -> None:
        """Drain *channel* in each cycle, once."""
        # Two ports may share an interface: drained once, its frames go to the handlers of both.
        if channel not in self._channels:
            self._channels.append(channel)
            self._drains.append(channel.drain)

    def connect_bus(self, bus: CyclicBus) -> None:
        """Exchange process data with *bus* in each cycle."""
        self.buses.append(bus)
        self._drains.append(bus.receive)
        self._supervisors.append(partial(_supervise, bus))
        self._closing.append(bus.exchange)
        self._attach()

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
            words[StationWord.SAMPLED_UNTIL] += elapsed  # a term, which readers extend
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
        for port in self._ports.values():
            if port.publisher is not None and state.sends and not before.sends:
                port.publisher.forget()

    def stop(self) -> None:
        """Stop receiving and sending."""
        self._enter(DeviceState.PREOP)
        for subscriber in self._subscribers.values():
            subscriber.close()

    def _enter(self, state: DeviceState) -> None:
        self.device.go(state)
        self._words[StationWord.STATE] = state
        self._sends = state.sends
        if self._compiled is not None:
            self._compiled.sends = state.sends
        if not state.receives:
            for requests in self._requests.values():
                requests.pop_all()

    def channel(self, port: str) -> FrameChannel:
        """Return the channel of *port*."""
        return self._ports[port].channel

    def prepare_handover(
        self,
        before: Station,
        added: Mapping[str, tuple[FrameChannel, Sequence[FrameChannel]]] = MappingProxyType({}),
        channels: Mapping[str, FrameChannel] = MappingProxyType({}),
        buses: Sequence[CyclicBus] | None = None,
    ) -> None:
        """Connect like *before*, and learn the frames that it receives.

        All slow work is done here, while *before* runs; it is only read.

        Args:
            before: The station in use.
            added: Channel and groups of each port that is new, or replaces another of its name.
            channels: Other channels of ports that stay.
            buses: Those that take part in its cycle; None for those of *before*.
        """
        for port, was in before._ports.items():
            if port in self._subscribers and port not in added:
                self.connect(port, channels.get(port, was.channel), was.groups)
                publisher = self._ports[port].publisher
                if publisher is not None and was.publisher is not None:
                    publisher.learn_from(was.publisher)
        for port, (channel, groups) in added.items():
            self.connect(port, channel, groups)
        self._added = frozenset(added)
        for bus in before.buses if buses is None else buses:
            self.connect_bus(bus)
        for port, subscriber in self._subscribers.items():
            if port not in added:
                subscriber.learn_from(before._subscribers[port])

    def follow(self, before: Station, now_ns: int) -> None:
        """Take the place of *before* between two of its cycles.

        The image already holds the content of the other.  Channels keep the handlers of *before*
        for the ports that stay.
        """
        self._inputs.reload()
        kept = self._subscribers.keys() - self._added
        replaced = [self._subscribers[port].handle_timeout for port in kept]
        self._supervisors = [each for each in self._supervisors if each not in replaced]
        for port in kept:
            self._keep_subscriber(port, before, now_ns)
        self._taps = before._taps
        self._connect_senders()
        for port, requests in self._requests.items():
            if port not in self._added and port in before._requests:
                requests.follow(before._requests[port])
        for name in self._polls.keys() & before._polls.keys():
            self._polls[name].follow(before._polls[name])
        for port, connected in self._ports.items():
            was = None if port in self._added else before._ports[port].publisher
            if connected.publisher is not None and was is not None:
                connected.publisher.follow(was)
            self._teach(port)
        self._enter(before.device.state)
        for port in self._added if self.device.state.receives else ():
            self._subscribers[port].resume(now_ns)

    def _keep_subscriber(self, port: str, before: Station, now_ns: int) -> None:
        """Take over the subscriber of *before* at *port*: channels hold its bound method."""
        subscriber, own = before._subscribers[port], self._subscribers[port]
        subscriber.swap_in(own, now_ns)
        self._subscribers[port], before._subscribers[port] = subscriber, own
        if subscriber.has_timeouts:
            self._supervisors.append(subscriber.handle_timeout)
        self.handlers[port] = before.handlers[port]
        if port in self._learners:
            self._learners[port] = before._learners[port]

    def release(self) -> None:
        """Free all parts one by one, after another station has taken over."""
        for port in self._ports.values():
            if port.publisher is not None:
                port.publisher.release()
        for subscriber in self._subscribers.values():
            subscriber.release()
        self.image.release()

    def cycle(self, due_ns: int, now_ns: int, behind_ns: int = 0) -> None:
        """Run one cycle that was due at *due_ns*, and late if *behind_ns* later has passed."""
        words = self._words
        cycle = words[_CYCLE] + 1
        words[_CYCLE] = cycle  # one by one: pack_into would show readers a 0 in between
        words[_CYCLE_AT_NS] = due_ns
        ordering.keep_order()
        if self._computes or self._drains or not cycle % self._rarely_every:
            changed = self._write_own_variables(cycle, now_ns)
        else:
            changed = self._inputs.refresh()
        if changed:
            _read_controls(self._outlets)
        for publisher, channel, _, _ in self._outlets if self._sends else ():
            frames = publisher.frames_to_send(cycle, now_ns)
            if frames:
                publisher.sent(channel.send(frames, now_ns), now_ns)
        if self._closing:
            for close in self._closing:
                close(now_ns)
        late_ns = now_ns - due_ns - behind_ns
        late_us = late_ns // 1000
        bin_ = BIN_OF_US[late_us] if 0 <= late_us < _BINS_KNOWN else histogram_bin(late_us)
        words[_LATENESS + bin_] += 1
        if late_ns > words[_LATENESS_MAX_NS]:  # noqa: PLR1730  max() takes five times as long
            words[_LATENESS_MAX_NS] = late_ns
        self._samples.end_cycle(cycle, now_ns)
        ordering.keep_order()
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
        if ordering.REORDERS:
            ordering.keep_order()
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
        if ordering.REORDERS:
            ordering.keep_order()
        words[_SEQUENCE] = sequence + 2
        return changed


def _read_controls(outlets: Iterable[_Outlet]) -> None:
    """Have publishers follow their control variables."""
    for publisher, _, _, _ in outlets:
        publisher.read_controls()


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
