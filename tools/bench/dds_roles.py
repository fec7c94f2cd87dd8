"""A peer: CycloneDDS, reliable, by its Python API; a sample is a whole EtherCAT frame."""

# No `from __future__ import annotations`: cyclonedds reads the annotations of a sample's class.

import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import monotonic_ns
from typing import Any

from cyclonedds.core import Policy, Qos, ReadCondition, SampleState, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, uint8
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from tools.bench.network import Page
from tools.bench.pacing import BURST, answer, send_for, send_stamps, wait
from tools.bench.stations import Shape
from tools.bench.timing import Latencies

_AT_ONCE = 256
_WINDOW = 192
"""Frames on their way that fit into the receive buffer of an ordinary user, so none is repeated."""
_STAMP = struct.Struct("<q")
_QOS = Qos(Policy.Reliability.Reliable(duration(seconds=1)), Policy.History.KeepLast(2 * _WINDOW))


def send(job: dict[str, Any]) -> None:
    """Patch the counter in one buffer and write it as a sample, again and again."""
    words, cycle = Page(Path(job["page"])).words, 0
    buffer = bytearray(Shape(**job["shape"]).frame_size)
    put = _STAMP.pack_into
    with _opened(job) as (participant, topic, sample):
        write = _writer(participant, topic).write

        def send_burst() -> None:
            nonlocal cycle
            for _ in range(BURST):
                cycle += 1
                put(buffer, 0, cycle)
                write(sample(bytes(buffer)))

        seconds = send_for(job["seconds"], send_burst, lambda: words[Page.RECEIVED], _WINDOW)
        answer({"sent": cycle, "seconds": seconds})


def receive(job: dict[str, Any]) -> None:
    """Take samples, unpack the counter and compare it."""
    words = Page(Path(job["page"])).words
    get, received, lost, last = _STAMP.unpack_from, 0, 0, 0
    with _opened(job) as (participant, topic, _):
        reader, waiting = _reader(participant, topic)
        while not words[Page.STOP]:
            waiting.wait(duration(milliseconds=100))
            while samples := reader.take(N=_AT_ONCE):
                for sample in samples:
                    (cycle,) = get(sample.data)
                    lost += cycle - last - 1
                    last = cycle
                received += len(samples)
                words[Page.RECEIVED] = received
    answer({"received": received, "lost": lost})


def send_paced(job: dict[str, Any]) -> None:
    """Write one sample a cycle; it begins with the time just before."""
    buffer = bytearray(Shape(**job["shape"]).frame_size)
    with _opened(job) as (participant, topic, sample):
        write = _writer(participant, topic).write

        def send_at(now_ns: int) -> None:
            _STAMP.pack_into(buffer, 0, now_ns)
            write(sample(bytes(buffer)))

        send_stamps(job["seconds"], send_at)


def receive_stamps(job: dict[str, Any]) -> None:
    """Wait for data; note when each sample has been taken."""
    words, latencies = Page(Path(job["page"])).words, Latencies()
    with _opened(job) as (participant, topic, _):
        reader, waiting = _reader(participant, topic)
        while not words[Page.STOP]:
            waiting.wait(duration(milliseconds=100))
            for sample in reader.take(N=_AT_ONCE):
                (sent_ns,) = _STAMP.unpack_from(sample.data)
                latencies.enter(monotonic_ns() - sent_ns)
    answer(latencies.summary())


@contextmanager
def _opened(job: dict[str, Any]) -> Iterator[tuple[Any, Any, Any]]:
    """Join the domain on the cable; yield participant, topic and the class of its samples."""
    network = f"<NetworkInterface name='{job['interface']}'/>"
    general = f"<General><Interfaces>{network}</Interfaces></General>"
    os.environ["CYCLONEDDS_URI"] = f"<CycloneDDS><Domain>{general}</Domain></CycloneDDS>"
    kind: Any = array[uint8, Shape(**job["shape"]).frame_size]

    @dataclass
    class Sample(IdlStruct, typename="eap.Frame"):  # type: ignore[call-arg,misc]
        data: kind

    participant = DomainParticipant(0)
    yield participant, Topic(participant, "frames", Sample, qos=_QOS), Sample


def _writer(participant: Any, topic: Any) -> Any:
    """Return a writer that has found its reader."""
    writer = DataWriter(participant, topic, qos=_QOS)
    while not writer.get_matched_subscriptions():
        wait(0.01)
    return writer


def _reader(participant: Any, topic: Any) -> tuple[Any, Any]:
    """Return a reader and what waits for its data; answer before the writer starts."""
    reader = DataReader(participant, topic, qos=_QOS)
    waiting = WaitSet(participant)
    waiting.attach(ReadCondition(reader, SampleState.NotRead))
    answer({"ready": True})
    return reader, waiting
