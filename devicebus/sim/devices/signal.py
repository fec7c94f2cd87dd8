"""Changing inputs of a simulated device: noise, recorded values, values of an output.

Noise is a function of the time alone, so that a run is repeatable.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from zlib import crc32

from devicebus.sim.devices.objects import INPUTS, OUTPUTS, object_ids_of
from devicebus.sim.spec import ChannelSpec, SlaveSpec
from devicebus.wire.alstatus import AlState
from eap.codec.datatypes import DataType
from eap.od.dictionary import ObjectDictionary
from eap.od.model import Entry

_MS = 1_000_000


class Signals:
    """Behaviour (devicebus.sim.device) that sets the inputs of *spec* by time.

    Raises:
        ValueError: a file has no numbers, or an input follows an unknown output.
    """

    def __init__(
        self, spec: SlaveSpec, dictionary: ObjectDictionary, resources: Mapping[str, bytes]
    ) -> None:
        outputs = dict(
            zip(
                (each.name for each in spec.outputs),
                object_ids_of(spec.outputs, OUTPUTS),
                strict=True,
            )
        )
        self._sources: list[tuple[Entry, Callable[[int], float]]] = []
        self._started_ns: int | None = None
        for channel, place in zip(spec.inputs, object_ids_of(spec.inputs, INPUTS), strict=True):
            source = _source(channel, dictionary, outputs, resources)
            if source is not None:
                self._sources.append((dictionary.entry(*place), source))

    def __bool__(self) -> bool:
        return bool(self._sources)

    def step(self, state: AlState, now_ns: int) -> None:
        """Set every input to its value at this time."""
        del state
        if self._started_ns is None:
            self._started_ns = now_ns
        for entry, source in self._sources:
            entry.value = _fit(entry.kind, source(now_ns - self._started_ns))


def read_csv(octets: bytes, name: str) -> list[float]:
    """Return the first number of each line, without empty lines and lines that begin with #.

    Raises:
        ValueError: a line does not begin with a number, or there is no line.
    """
    values = []
    for number, line in enumerate(octets.decode("utf-8", "replace").splitlines(), 1):
        text = line.replace(";", ",").partition(",")[0].strip()
        if not text or text.startswith("#"):
            continue
        try:
            values.append(float(text))
        except ValueError:
            raise ValueError(f"{name}:{number}: {text!r} is not a number") from None
    if not values:
        raise ValueError(f"{name} holds no values")
    return values


def _source(
    channel: ChannelSpec,
    dictionary: ObjectDictionary,
    outputs: Mapping[str, tuple[int, int]],
    resources: Mapping[str, bytes],
) -> Callable[[int], float] | None:
    period_ns = channel.period_ms * _MS
    if channel.follows:
        if channel.follows not in outputs:
            raise ValueError(f"{channel.name} follows {channel.follows!r}, which is no output")
        followed = dictionary.entry(*outputs[channel.follows])
        return lambda elapsed_ns: float(followed.value)
    if channel.csv or channel.values:
        recorded: Sequence[float] = channel.values
        if channel.csv:
            recorded = read_csv(resources[channel.csv], channel.csv)
        return lambda elapsed_ns: recorded[elapsed_ns // period_ns % len(recorded)]
    if channel.noise:
        middle = float(channel.value)
        return lambda elapsed_ns: (
            middle + channel.noise * _noise(channel.name, elapsed_ns // period_ns)
        )
    return None


def _noise(name: str, number: int) -> float:
    """Return a pseudo-random number from -1 to 1."""
    return crc32(f"{name}:{number}".encode()) / 0x7FFF_FFFF - 1


def _fit(kind: DataType, value: float) -> int | float:
    if kind.scalar_range is None:
        return value
    low, high = kind.scalar_range
    bounded = max(low, min(high, value))
    return bounded if isinstance(low, float) else round(bounded)
