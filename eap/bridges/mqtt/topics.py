"""Topics of values, and what both kinds of messages share: waiting values and commands."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol, TypeAlias

from eap.ams.mqtt.network import Publish, Subscribe
from eap.bridges.values import BridgeVariable, Sample
from eap.errors import EapError

Outgoing: TypeAlias = Publish | Subscribe
MAX_PAYLOAD = 65_536
"""Bytes of the longest command."""
_FORBIDDEN = re.compile(r"[/+#\x00-\x1f]")


class WriteCommand(NamedTuple):
    """Value that a client wants to be written.

    Attributes:
        name: ``STATION/NAME``.
        value: In its plain form.
        topic: Topic of the message.
        reference: The client's *id* of the command; None without one.
    """

    name: str
    value: Any
    topic: str
    reference: Any = None


class MessageCore(Protocol):
    """Messages of one connection to a broker, without I/O; time is Unix time.

    Attributes:
        has_waiting: True if :meth:`messages` has some.
    """

    @property
    def has_waiting(self) -> bool:
        """True if :meth:`messages` has some."""

    def will(self) -> Publish:
        """Return the last will of the next connection."""

    def set_variables(self, variables: Mapping[str, BridgeVariable], now_ns: int) -> None:
        """Take the variables that there are from now on."""

    def connected(self, samples: Mapping[str, Sample], now_ns: int) -> None:
        """Begin with a new connection: births, and all present values."""

    def disconnected(self) -> None:
        """Forget what waits: after the next connection all is sent anew."""

    def put(self, samples: Mapping[str, Sample]) -> int:
        """Take values that changed; return how many older ones they replace unsent."""

    def put_due(self, samples: Mapping[str, Sample], now_ns: int) -> int:
        """Take the values that are due by their period; return as :meth:`put`."""

    def messages(self, most: int, now_ns: int) -> tuple[list[Outgoing], int]:
        """Return up to *most* messages to send, and the number of values in them."""

    def receive(
        self, topic: str, payload: bytes, now_ns: int, *, is_retained: bool
    ) -> list[WriteCommand]:
        """Return the commands in a message; raise CommandError if it is refused."""

    def answer(self, command: WriteCommand, error: str, now_ns: int) -> Publish | None:
        """Return the answer to a command, None where clients get none; *error* is empty if done."""


class CommandError(EapError):
    """Message that is no valid command.

    Attributes:
        command: What could be read of it, for the answer; None if it is of no variable.
    """

    def __init__(self, message: str, command: WriteCommand | None = None) -> None:
        super().__init__(message)
        self.command = command


def level(text: str) -> str:
    """Return *text* as a level of a topic."""
    return _FORBIDDEN.sub("_", text)


class TopicPattern:
    """Pattern of topics with ``{plant}``, ``{station}`` and ``{variable}``."""

    def __init__(self, pattern: str, plant: str) -> None:
        self._pattern = pattern.replace("{plant}", level(plant))

    def topic(self, variable: BridgeVariable) -> str:
        """Return the topic of a variable."""
        topic = self._pattern.replace("{station}", level(variable.station))
        return topic.replace("{variable}", level(variable.variable))


class WaitingValues:
    """Latest values that were not sent yet, in the order in which they came."""

    def __init__(self) -> None:
        self._samples: dict[str, Sample] = {}

    def __bool__(self) -> bool:
        return bool(self._samples)

    def put(self, samples: Mapping[str, Sample]) -> int:
        """Take values; return how many older ones they replace."""
        replaced = len(self._samples.keys() & samples.keys())
        self._samples |= samples
        return replaced

    def take(self, most: int) -> dict[str, Sample]:
        """Return up to *most* values, the oldest first, and remove them."""
        if len(self._samples) <= most:
            taken, self._samples = self._samples, {}
            return taken
        names = list(self._samples)[:most]
        return {name: self._samples.pop(name) for name in names}

    def keep(self, names: Iterable[str]) -> None:
        """Forget all others."""
        kept = set(names)
        self._samples = {name: each for name, each in self._samples.items() if name in kept}

    def clear(self) -> None:
        """Forget all."""
        self._samples = {}


class PeriodicGroup:
    """Variables that are published every *every_ms*, changed or not."""

    def __init__(self, every_ms: int) -> None:
        self.names: Sequence[str] = ()
        self._every_ns = every_ms * 1_000_000
        self._due_ns = 0

    def take_due(self, samples: Mapping[str, Sample], now_ns: int) -> dict[str, Sample]:
        """Return the present values if they are due."""
        if now_ns < self._due_ns:
            return {}
        # On a fixed grid, so that the period is right in the mean; a clock that was set back, or
        # far ahead, begins a new one.
        self._due_ns += self._every_ns
        if not now_ns < self._due_ns <= now_ns + self._every_ns:
            self._due_ns = now_ns + self._every_ns
        return {name: samples[name] for name in self.names if name in samples}
