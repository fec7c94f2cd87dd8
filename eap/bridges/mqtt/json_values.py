"""JSON messages: a retained value on a topic of each variable, commands and their results."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import msgspec

from eap.ams.mqtt.network import Publish, Subscribe
from eap.bridges.mqtt.home_assistant import DiscoveryDocuments
from eap.bridges.mqtt.topics import (
    MAX_PAYLOAD,
    CommandError,
    Outgoing,
    PeriodicGroup,
    TopicPattern,
    WaitingValues,
    WriteCommand,
    level,
)
from eap.bridges.values import BridgeVariable, Sample
from eap.codec import datatypes
from eap.codec.enumerations import Enumeration
from eap.codec.structures import Structure
from eap.config.bridge_sections import MqttSection
from eap.patterns import match_names

ONLINE, OFFLINE = b"online", b"offline"
_SET, _RESULT = "/set", "/result"
_SUBSCRIBED_AT_ONCE = 100
_COMMAND_KEYS = frozenset(("value", "id"))


class JsonValues:
    """JSON messages of one connection (MessageCore).

    Args:
        section: The key ``mqtt``.
        plant: Name of the plant.
        instance: Name of the appliance, for its status.
    """

    def __init__(self, section: MqttSection, plant: str, instance: str) -> None:
        self._qos, self._retain = section.qos, section.retain
        self._commands = section.commands
        self._pattern = TopicPattern(section.topic, plant)
        self._status = f"{level(plant)}/status"
        if instance != plant:
            self._status += f"/{level(instance.removeprefix(f'{plant}@'))}"
        self._discovery = DiscoveryDocuments(section.discovery, plant, self._status)
        self._groups = [(each.patterns, PeriodicGroup(each.every_ms)) for each in section.publish]
        self._is_periodic = [bool(each.every_ms) for each in section.publish]
        self._variables: Mapping[str, BridgeVariable] = {}
        self._topics: dict[str, str] = {}
        self._units: dict[str, str] = {}
        self._settable: dict[str, str] = {}
        self._on_change: frozenset[str] = frozenset()
        self._first: list[Outgoing] = []
        self._waiting = WaitingValues()
        self._is_connected = False

    @property
    def has_waiting(self) -> bool:
        """True if there are messages to send."""
        return bool(self._first or self._waiting)

    def will(self) -> Publish:
        """Return the status of an appliance that has gone."""
        return Publish(self._status, OFFLINE, 1, is_retained=True)

    def set_variables(self, variables: Mapping[str, BridgeVariable], now_ns: int) -> None:
        """Take the variables that there are from now on; topics of others are cleared."""
        del now_ns
        before = self._topics
        self._variables = variables
        topics = {name: self._pattern.topic(each) for name, each in variables.items()}
        published: set[str] = set()
        on_change: set[str] = set()
        for (patterns, group), is_periodic in zip(self._groups, self._is_periodic, strict=True):
            fits = {name for pattern in patterns for name in match_names(pattern, variables)}
            # The first entry of the plant file that fits a variable decides.
            names = [name for name in variables if name in fits and name not in published]
            published.update(names)
            group.names = names if is_periodic else ()
            on_change.update(() if is_periodic else names)
        self._on_change = frozenset(on_change)
        self._topics = {name: topics[name] for name in variables if name in published}
        self._units = {name: variables[name].unit for name in self._topics}
        commanded = {n for pattern in self._commands for n in match_names(pattern, variables)}
        self._settable = {
            f"{topics[name]}{_SET}": name
            for name in variables
            if name in commanded and variables[name].is_settable
        }
        self._waiting.keep(self._topics)
        if self._is_connected:
            gone = set(before.values()) - set(self._topics.values())
            if self._retain:
                # An empty payload has the broker forget a retained message (MQTT 3.1.1, 3.3.1.3).
                self._first += (Publish(each, b"", 1, is_retained=True) for each in sorted(gone))
            self._first += self._subscriptions()
            self._first += self._discover()

    def connected(self, samples: Mapping[str, Sample], now_ns: int) -> None:
        """Begin with a new connection: status, discovery and all present values."""
        del now_ns
        self._is_connected = True
        self._first = [*self._subscriptions(), Publish(self._status, ONLINE, 1, is_retained=True)]
        self._first += self._discover()
        self._waiting.clear()
        self._waiting.put({name: each for name, each in samples.items() if name in self._topics})

    def disconnected(self) -> None:
        """Forget what waits."""
        self._is_connected = False
        self._first = []
        self._waiting.clear()

    def put(self, samples: Mapping[str, Sample]) -> int:
        """Take values that changed; return how many older ones they replace unsent."""
        if not self._is_connected:
            return 0
        chosen = {name: each for name, each in samples.items() if name in self._on_change}
        return self._waiting.put(chosen)

    def put_due(self, samples: Mapping[str, Sample], now_ns: int) -> int:
        """Take the values that are due by their period; return as :meth:`put`."""
        if not self._is_connected:
            return 0
        groups = (group for _, group in self._groups if group.names)
        return sum(self._waiting.put(group.take_due(samples, now_ns)) for group in groups)

    def messages(self, most: int, now_ns: int) -> tuple[list[Outgoing], int]:
        """Return up to *most* messages to send, and the number of values in them."""
        del now_ns
        found, self._first = self._first[:most], self._first[most:]
        taken = self._waiting.take(most - len(found))
        found += (self._message(name, sample) for name, sample in taken.items())
        return found, len(taken)

    def receive(
        self, topic: str, payload: bytes, now_ns: int, *, is_retained: bool
    ) -> list[WriteCommand]:
        """Return the command in a message; raise CommandError if it is refused."""
        del now_ns
        name = self._settable.get(topic)
        if name is None:
            raise CommandError(f"{topic}: no variable has this topic")
        command = WriteCommand(name, None, topic)
        if is_retained:
            reason = "a retained command is not executed: it would be again after each reconnection"
            raise CommandError(reason, command)
        if len(payload) > MAX_PAYLOAD:
            raise CommandError(f"a command has at most {MAX_PAYLOAD} bytes", command)
        kind = datatypes.parse(self._variables[name].type)
        try:
            return [command._replace(**_content(kind, payload))]
        except ValueError as exc:
            raise CommandError(str(exc), command) from None

    def answer(self, command: WriteCommand, error: str, now_ns: int) -> Publish:
        """Return the result of a command."""
        document: dict[str, Any] = {"ok": not error, "value": command.value}
        if error:
            document["error"] = error
        if command.reference is not None:
            document["id"] = command.reference
        document["time"] = _seconds(now_ns)
        topic = f"{command.topic.removesuffix(_SET)}{_RESULT}"
        return Publish(topic, msgspec.json.encode(document), self._qos)

    def _message(self, name: str, sample: Sample) -> Publish:
        document = {
            "value": sample.value,
            "unit": self._units[name],
            "quality": sample.quality,
            "time": _seconds(sample.time_ns),
        }
        payload = msgspec.json.encode(document)
        return Publish(self._topics[name], payload, self._qos, self._retain)

    def _subscriptions(self) -> Iterator[Subscribe]:
        topics = list(self._settable)
        # Brokers limit the size of a packet.
        for first in range(0, len(topics), _SUBSCRIBED_AT_ONCE):
            yield Subscribe(topics[first : first + _SUBSCRIBED_AT_ONCE])

    def _discover(self) -> Iterator[Publish]:
        settable = {name: topic for topic, name in self._settable.items()}
        chosen = {name: self._variables[name] for name in self._topics}
        return self._discovery.messages(chosen, self._topics, settable)


def _seconds(time_ns: int) -> float:
    return round(time_ns / 1e9, 3)


def _content(kind: datatypes.DataType, payload: bytes) -> dict[str, Any]:
    """Return value and reference of a command; raise ValueError if the payload is no value."""
    try:
        value = msgspec.json.decode(payload)
    except (ValueError, RecursionError):
        # A bare word is a text: programs that send one seldom add quotes.
        if not (kind.is_text or isinstance(kind, Enumeration)):
            reason = 'the payload is not JSON: send a value such as 7, true or {"value": 7}'
            raise ValueError(reason) from None
        value = payload.decode()
    if not isinstance(value, dict) or "value" not in value or value.keys() - _COMMAND_KEYS:
        return {"value": value}
    # A struct may have a member of that name.
    if isinstance(kind, Structure) and value.keys() <= kind.by_name.keys():
        return {"value": value}
    return {"value": value["value"], "reference": value.get("id")}
