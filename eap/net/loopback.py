"""A line in memory that joins all ports of one name: ``loop://NAME``.

It behaves like a hub with configurable faults, and takes the time as an argument, so that a plant,
or a test of one, runs the same way every time.
"""

from __future__ import annotations

import itertools
import random
from collections.abc import Sequence
from dataclasses import dataclass

from eap.errors import ConfigError
from eap.ids import InterfaceUri
from eap.pd.link import FrameHandler, OutFrame, exchange

DRAIN_LIMIT = 256
HOLD_NS = 100_000_000
"""Longest time that a frame to be reordered waits for the one that overtakes it."""
_ADDRESS = "port "
"""Prefix of the addresses of ports; only answers have such a destination."""
_numbers = itertools.count(1)


@dataclass(frozen=True, slots=True)
class Faults:
    """Faults of the frames that one port sends; shares are between 0 and 1."""

    delay_ns: int = 0
    loss: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    seed: int = 0

    @classmethod
    def parse(cls, uri: InterfaceUri) -> Faults:
        """Read ``delay_us``, ``loss``, ``duplicate``, ``reorder`` and ``seed``.

        Raises:
            ConfigError: an option is unknown, or its value is invalid.
        """
        values: dict[str, float] = {}
        for name, text in uri.options:
            if name not in {"delay_us", "loss", "duplicate", "reorder", "seed"}:
                raise ConfigError(
                    f"{uri}: unknown option {name!r}, expected delay_us, loss, duplicate, "
                    "reorder or seed"
                )
            try:
                values[name] = int(text) if name == "seed" else float(text)
            except ValueError:
                raise ConfigError(f"{uri}: {name} is {text!r}, expected a number") from None
            limit = 1.0 if name in {"loss", "duplicate", "reorder"} else 2.0**53
            if not 0 <= values[name] <= limit:
                raise ConfigError(f"{uri}: {name} is {text}, expected 0 to {limit:.0f}")
        return cls(
            delay_ns=round(values.get("delay_us", 0) * 1000),
            loss=values.get("loss", 0.0),
            duplicate=values.get("duplicate", 0.0),
            reorder=values.get("reorder", 0.0),
            seed=int(values.get("seed", 0)),
        )


class _FrameInFlight:
    """One frame under way to one port."""

    __slots__ = ("data", "due_ns", "order", "sender")

    def __init__(self, data: memoryview, due_ns: int, order: float, sender: str) -> None:
        self.data = data
        self.sender = sender
        self.due_ns = due_ns
        self.order = order


class LoopbackChannel:
    """One port on a line; what it sends reaches every other port of the line.

    An answer reaches only the port that sent the request.
    """

    minimum_size = 0
    direct = None

    def __init__(self, ports: list[LoopbackChannel], faults: Faults) -> None:
        self.handlers: list[FrameHandler] = []
        self.errors: dict[str, int] = {}
        self._ports = ports
        self._faults = faults
        self._random = random.Random(faults.seed)  # noqa: S311  repeatable, not secret
        self._queue: list[_FrameInFlight] = []
        self._held: list[_FrameInFlight] = []
        self._order = 0
        self._address = f"{_ADDRESS}{next(_numbers)}"
        self._sender = ""

    def join(self) -> None:
        """Receive the frames of the line from now on."""
        self._ports.append(self)

    def drain(self, now_ns: int) -> int:
        """Hand over the frames that have arrived by *now_ns*, in the order of arrival."""
        if not self._queue:
            return 0
        due = [frame for frame in self._queue if frame.due_ns <= now_ns]
        due.sort(key=lambda frame: (frame.due_ns, frame.order))
        del due[DRAIN_LIMIT:]
        for frame in due:
            self._queue.remove(frame)
        for frame in due:
            self._sender = frame.sender
            for handle in self.handlers:
                handle(frame.data, len(frame.data), frame.due_ns, self)
        return len(due)

    def exchange_handler(self, old: FrameHandler, new: FrameHandler) -> None:
        """Hand to *new* the frames that were handed to *old*, if it is a handler here."""
        exchange(self.handlers, old, new)

    def sender_of(self, data: memoryview) -> str:
        """Return which port of the line sent *data*."""
        del data  # the one that is being handed over
        return self._sender

    def source_of(self, data: memoryview) -> bytes:
        """Return nothing: a line in memory has no addresses."""
        del data
        return b""

    def send(self, frames: Sequence[OutFrame], now_ns: int) -> Sequence[OutFrame]:
        """Put copies of *frames* on the line; a lost frame counts as sent, as on a wire."""
        for frame in frames:
            to, ports = frame.destination, self._ports
            if to.startswith(_ADDRESS):
                ports = [port for port in ports if port._address == to]  # noqa: SLF001  as below
            self._transmit(memoryview(bytes(frame.view[frame.headroom :])), now_ns, ports)
        return ()

    def link_header(self, destination: str) -> bytes:
        """Return nothing: every port of the line receives frames to any *destination*."""
        del destination
        return b""

    def close(self) -> None:
        """Leave the line."""
        self._ports.remove(self)

    def _transmit(self, data: memoryview, now_ns: int, ports: Sequence[LoopbackChannel]) -> None:
        faults, draw = self._faults, self._random.random
        due_ns = now_ns + faults.delay_ns
        overtaken, self._held = self._held, []
        for port in ports:
            if port is self or (faults.loss and draw() < faults.loss):
                continue
            for _ in range(2 if faults.duplicate and draw() < faults.duplicate else 1):
                self._order += 1
                frame = _FrameInFlight(data, due_ns, self._order, self._address)
                port._queue.append(frame)  # noqa: SLF001  another port of the same line
                if faults.reorder and draw() < faults.reorder:
                    frame.due_ns += HOLD_NS
                    self._held.append(frame)
        for frame in overtaken:
            # Held frames leave behind the one that overtook them; HOLD_NS has not passed yet.
            if frame.due_ns > due_ns:
                self._order += 1
                frame.due_ns, frame.order = due_ns, self._order


class LoopbackLines:
    """All lines of one process, by name."""

    def __init__(self) -> None:
        self._lines: dict[str, list[LoopbackChannel]] = {}

    def make(self, uri: InterfaceUri) -> LoopbackChannel:
        """Return a new port for the line that *uri* names, which receives nothing before it joins.

        The options of *uri* are the faults of its frames.

        Raises:
            ConfigError: the options of *uri* are wrong.
        """
        return LoopbackChannel(self._lines.setdefault(uri.host, []), Faults.parse(uri))

    def open(self, uri: InterfaceUri) -> LoopbackChannel:
        """Return a new port on the line; arguments and errors are those of :meth:`make`."""
        channel = self.make(uri)
        channel.join()
        return channel
