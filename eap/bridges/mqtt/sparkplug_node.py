"""Edge node of Sparkplug B: the appliance as a node, each of its stations as a device.

Rules of Sparkplug 3.0: the last will is NDEATH with the ``bdSeq`` of the NBIRTH that follows; the
messages of a node are numbered from NBIRTH (0) on, modulo 256; a host that misses a number requests
a rebirth, which repeats all births with the same ``bdSeq``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from eap.ams.mqtt.network import Publish, Subscribe
from eap.bridges.mqtt.sparkplug_types import TemplateTypes, metric_type, plain_value
from eap.bridges.mqtt.topics import (
    MAX_PAYLOAD,
    CommandError,
    Outgoing,
    PeriodicGroup,
    WaitingValues,
    WriteCommand,
    level,
)
from eap.bridges.values import BridgeVariable, Quality, Sample
from eap.codec import datatypes
from eap.codec.basetypes import DataType
from eap.codec.sparkplug import Metric, MetricType, decode_payload, encode_payload
from eap.config.bridge_sections import MqttSection, SparkplugSection
from eap.errors import CodecError
from eap.patterns import match_names

REBIRTH = "Node Control/Rebirth"
QUALITIES = {Quality.GOOD: 192, Quality.STALE: 500, Quality.BAD: 0}
"""Values of the property ``Quality``."""
_NAMESPACE = "spBv1.0"
_AT_ONCE = 1000
"""Values of one DDATA."""
_SEQUENCES = 256
_REBIRTH_ALIAS = 0


class _Device:
    """One station: its metrics, and whether a host knows it."""

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.names: list[str] = []
        self.is_born = False
        self.waiting = WaitingValues()
        self.stale: set[str] = set()
        """Variables whose latest value is stale."""


class SparkplugNode:
    """Messages of one edge node (MessageCore).

    Args:
        section: The key ``mqtt``.
        sparkplug: Its key ``sparkplug``.
        instance: Name of the appliance: that of the node unless given.
    """

    def __init__(self, section: MqttSection, sparkplug: SparkplugSection, instance: str) -> None:
        self._group, self._node = level(sparkplug.group), level(sparkplug.node or instance)
        self._publish = section.publish
        self._commands = section.commands
        self._bd_seq = -1
        self._seq = 0
        self._variables: Mapping[str, BridgeVariable] = {}
        self._kinds: dict[str, DataType] = {}
        self._aliases: dict[str, int] = {}
        self._by_alias: dict[int, str] = {}
        self._commanded: frozenset[str] = frozenset()
        self._on_change: frozenset[str] = frozenset()
        self._periodic: list[PeriodicGroup] = []
        self._templates = TemplateTypes()
        self._devices: dict[str, _Device] = {}
        self._samples: Mapping[str, Sample] = {}
        self._first: list[Outgoing] = []
        self._is_connected = False
        self._is_unborn = False
        self._knows_variables = False

    @property
    def has_waiting(self) -> bool:
        """True if there are messages to send."""
        return bool(
            self._first or self._is_unborn or any(each.waiting for each in self._devices.values())
        )

    def will(self) -> Publish:
        """Return NDEATH of the next connection, whose NBIRTH has the same ``bdSeq``."""
        self._bd_seq = (self._bd_seq + 1) % _SEQUENCES
        metric = Metric("bdSeq", MetricType.INT64, self._bd_seq)
        # Without a sequence number, which the broker cannot know when it sends the will.
        return Publish(self._topic("NDEATH"), encode_payload(0, [metric], None), 1)

    def set_variables(self, variables: Mapping[str, BridgeVariable], now_ns: int) -> None:
        """Take the variables that there are from now on; all is born again."""
        del now_ns
        published: dict[str, int] = {}
        for each in self._publish:
            for pattern in each.patterns:
                for name in match_names(pattern, variables):
                    published.setdefault(name, each.every_ms)
        commanded = {n for pattern in self._commands for n in match_names(pattern, variables)}
        names = [name for name in variables if name in published]
        self._variables = variables
        self._commanded = frozenset(n for n in commanded if variables[n].is_settable)
        self._on_change = frozenset(name for name in names if not published[name])
        self._periodic = []
        for period in dict.fromkeys(filter(None, published.values())):
            group = PeriodicGroup(period)
            group.names = [name for name in names if published[name] == period]
            self._periodic.append(group)
        self._kinds = {name: datatypes.parse(variables[name].type) for name in names}
        # Aliases are unique within the node: DDATA has them instead of names.
        self._aliases = {name: alias for alias, name in enumerate(names, _REBIRTH_ALIAS + 1)}
        self._by_alias = {alias: name for name, alias in self._aliases.items()}
        self._templates = TemplateTypes()
        for kind in self._kinds.values():
            self._templates.add(kind)
        self._devices = {}
        for name in names:
            station = variables[name].station
            device = self._devices.setdefault(station, _Device(level(station)))
            device.names.append(name)
        self._knows_variables = True
        self._is_unborn = self._is_connected

    def connected(self, samples: Mapping[str, Sample], now_ns: int) -> None:
        """Begin with a new connection: subscriptions, NBIRTH, and DBIRTH of what has values."""
        del now_ns
        self._is_connected = True
        # Without templates a birth would be of no use: it waits until the variables are known.
        self._is_unborn = self._knows_variables
        self._samples = samples
        self._first = [Subscribe((self._topic("NCMD"), f"{self._topic('DCMD')}/+"))]

    def disconnected(self) -> None:
        """Forget what waits."""
        self._is_connected = self._is_unborn = False
        self._first = []
        for device in self._devices.values():
            device.is_born = False
            device.waiting.clear()

    def put(self, samples: Mapping[str, Sample]) -> int:
        """Take values that changed; return how many older ones they replace unsent."""
        return self._put({n: each for n, each in samples.items() if n in self._on_change}, samples)

    def put_due(self, samples: Mapping[str, Sample], now_ns: int) -> int:
        """Take the values that are due by their period; return as :meth:`put`."""
        self._samples = samples
        due: dict[str, Sample] = {}
        for group in self._periodic:
            due |= group.take_due(samples, now_ns)
        return self._put(due, due)

    def _put(self, chosen: Mapping[str, Sample], all_of: Mapping[str, Sample]) -> int:
        replaced = 0
        if not self._is_connected:
            return replaced
        by_station: dict[str, dict[str, Sample]] = {}
        for name, each in chosen.items():
            by_station.setdefault(self._variables[name].station, {})[name] = each
        for station, own in by_station.items():
            replaced += self._devices[station].waiting.put(own)
        for name, each in all_of.items():
            if name in self._aliases:
                stale = self._devices[self._variables[name].station].stale
                (stale.add if each.quality is Quality.STALE else stale.discard)(name)
        return replaced

    def messages(self, most: int, now_ns: int) -> tuple[list[Outgoing], int]:
        """Return up to *most* messages to send, and the number of values in them."""
        if not self._is_connected:
            return [], 0
        found, self._first = self._first, []
        sent = 0
        if self._is_unborn:
            self._is_unborn = False
            self._seq = 0
            found.append(self._node_birth(now_ns))
            for device in self._devices.values():
                device.is_born = False
                device.waiting.clear()
        for device in self._devices.values():
            if len(found) >= most:
                break
            message, count = self._device_message(device, now_ns)
            if message is not None:
                found.append(message)
                sent += count
        return found, sent

    def _device_message(self, device: _Device, now_ns: int) -> tuple[Publish | None, int]:
        """Return the next message of a station: birth, death or data."""
        present = [name for name in device.names if name in self._samples]
        is_lost = bool(present) and device.stale.issuperset(present)
        if not device.is_born:
            # Births wait for the values of the station, and for fresh ones.
            if len(present) < len(device.names) or is_lost:
                device.waiting.clear()
                return None, 0
            device.is_born = True
            device.waiting.clear()
            metrics = [self._metric(n, self._samples[n], is_birth=True) for n in device.names]
            return self._numbered("DBIRTH", metrics, now_ns, device), len(metrics)
        if not device.waiting:
            return None, 0
        # A host that was told of the death shows all metrics of the station as stale.
        if is_lost:
            device.is_born = False
            device.waiting.clear()
            return self._numbered("DDEATH", [], now_ns, device), 0
        taken = device.waiting.take(_AT_ONCE)
        metrics = [self._metric(name, each, is_birth=False) for name, each in taken.items()]
        return self._numbered("DDATA", metrics, now_ns, device), len(metrics)

    def receive(
        self, topic: str, payload: bytes, now_ns: int, *, is_retained: bool
    ) -> list[WriteCommand]:
        """Return the commands in a message; raise CommandError if it is refused."""
        del now_ns
        if is_retained:
            raise CommandError(f"{topic}: a retained command is not executed")
        if len(payload) > MAX_PAYLOAD:
            raise CommandError(f"{topic}: a command has at most {MAX_PAYLOAD} bytes")
        try:
            metrics = decode_payload(payload).metrics
        except CodecError as exc:
            raise CommandError(f"{topic}: {exc}") from None
        if topic == self._topic("NCMD"):
            if not any(_is_rebirth(each) for each in metrics):
                raise CommandError(f"{topic}: unknown command; expected {REBIRTH!r}")
            self._is_unborn = True
            return []
        station = topic.rpartition("/")[2]
        device = next((name for name, d in self._devices.items() if d.topic == station), None)
        if device is None:
            raise CommandError(f"{topic}: unknown station {station!r}")
        return [self._command(topic, device, each) for each in metrics]

    def answer(self, command: WriteCommand, error: str, now_ns: int) -> None:
        """Return None: hosts see the new value, or that it did not change."""
        del command, error, now_ns

    def _command(self, topic: str, station: str, metric: Metric) -> WriteCommand:
        name = f"{station}/{metric.name}"
        # Hosts may write by the alias of the birth instead of by the name.
        if not metric.name and metric.alias is not None:
            name = self._by_alias.get(metric.alias, "")
        variable = self._variables.get(name)
        if variable is None or variable.station != station or name not in self._kinds:
            which = repr(metric.name) if metric.name else f"with alias {metric.alias}"
            raise CommandError(f"{topic}: unknown metric {which}")
        command = WriteCommand(name, None, topic)
        if name not in self._commanded:
            raise CommandError(f"{name}: commands do not name it, or it cannot be set", command)
        present = self._samples.get(name)
        try:
            value = plain_value(
                self._kinds[name], metric, None if present is None else present.value
            )
        except ValueError as exc:
            raise CommandError(f"{name}: {exc}", command) from None
        return command._replace(value=value)

    def _node_birth(self, now_ns: int) -> Publish:
        metrics = [
            Metric("bdSeq", MetricType.INT64, self._bd_seq),
            Metric(REBIRTH, MetricType.BOOLEAN, value=False, alias=_REBIRTH_ALIAS),
            *self._templates.definitions(),
        ]
        return self._numbered("NBIRTH", metrics, now_ns)

    def _metric(self, name: str, sample: Sample, *, is_birth: bool) -> Metric:
        kind = self._kinds[name]
        properties: list[tuple[str, int | str]] = [("Quality", QUALITIES[sample.quality])]
        variable = self._variables[name]
        if is_birth and variable.unit:
            properties.append(("engUnit", variable.unit))
        if is_birth and variable.comment:
            properties.append(("documentation", variable.comment))
        return Metric(
            variable.variable if is_birth else "",
            metric_type(kind),
            self._templates.value(kind, sample.value),
            self._aliases[name],
            sample.time_ns // 1_000_000,
            properties,
        )

    def _numbered(
        self, kind: str, metrics: Iterable[Metric], now_ns: int, device: _Device | None = None
    ) -> Publish:
        topic = self._topic(kind) if device is None else f"{self._topic(kind)}/{device.topic}"
        payload = encode_payload(now_ns // 1_000_000, metrics, self._seq)
        self._seq = (self._seq + 1) % _SEQUENCES
        return Publish(topic, payload, 0)

    def _topic(self, kind: str) -> str:
        return f"{_NAMESPACE}/{self._group}/{kind}/{self._node}"


def _is_rebirth(metric: Metric) -> bool:
    is_named = metric.name == REBIRTH or (not metric.name and metric.alias == _REBIRTH_ALIAS)
    return is_named and metric.value is True
