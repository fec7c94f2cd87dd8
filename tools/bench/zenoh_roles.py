"""A peer: zenoh over TCP, a key and a message for each PD, which its transport puts into batches.

A frame of one PD is one message with the whole EtherCAT frame; of more PDs each is one with its
data and the counter of the frame before it.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import monotonic_ns
from typing import Any

import zenoh

from tools.bench.network import Page
from tools.bench.pacing import BURST, answer, send_for, send_stamps, wait
from tools.bench.stations import Shape
from tools.bench.timing import Latencies

_PORT = 5600
_ROOT = "eap/pd"
_TELL_EVERY = 32
_STAMP = struct.Struct("<q")


def send(job: dict[str, Any]) -> None:
    """Put each PD of each frame, again and again."""
    words, shape = Page(Path(job["page"])).words, Shape(**job["shape"])
    buffer, put, cycle = bytearray(_size(shape)), _STAMP.pack_into, 0
    with _publishers(job, shape.pds) as publishers:
        puts = [publisher.put for publisher in publishers]

        def send_burst() -> None:
            nonlocal cycle
            for _ in range(BURST):
                cycle += 1
                for put_one in puts:
                    put(buffer, 0, cycle)
                    put_one(buffer)

        seconds = send_for(job["seconds"], send_burst, lambda: words[Page.RECEIVED])
        answer({"sent": cycle, "seconds": seconds})


def receive(job: dict[str, Any]) -> None:
    """Take each message in a callback, unpack the counter and compare it."""
    words, pds = Page(Path(job["page"])).words, Shape(**job["shape"]).pds
    get = _STAMP.unpack_from
    received = lost = last = 0

    def take(sample: zenoh.Sample) -> None:
        nonlocal received, lost, last
        (cycle,) = get(sample.payload.to_bytes())
        if cycle != last:
            lost += cycle - last - 1
            last = cycle
        received += 1
        if not received % _TELL_EVERY:
            words[Page.RECEIVED] = received // pds

    with _subscriber(job, take):
        while not words[Page.STOP]:
            wait(0.01)
            words[Page.RECEIVED] = received // pds
    answer({"received": received // pds, "lost": lost})


def send_paced(job: dict[str, Any]) -> None:
    """Put one PD a cycle, whose data begins with the time just before."""
    buffer, put = bytearray(_size(Shape(**job["shape"]))), _STAMP.pack_into
    with _publishers(job, 1, express=True) as (publisher,):

        def send_at(now_ns: int) -> None:
            put(buffer, 0, now_ns)
            publisher.put(buffer)

        send_stamps(job["seconds"], send_at)


def receive_stamps(job: dict[str, Any]) -> None:
    """Note in a callback when a message has come."""
    words, latencies = Page(Path(job["page"])).words, Latencies()

    def take(sample: zenoh.Sample) -> None:
        (sent_ns,) = _STAMP.unpack_from(sample.payload.to_bytes())
        latencies.enter(monotonic_ns() - sent_ns)

    with _subscriber(job, take):
        while not words[Page.STOP]:
            wait(0.01)
    answer(latencies.summary())


def _size(shape: Shape) -> int:
    return shape.frame_size if shape.pds == 1 else shape.size


def _session(job: dict[str, Any], side: str) -> zenoh.Session:
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5(f"{side}/endpoints", f'["tcp/{job["far"]}:{_PORT}"]')
    return zenoh.open(config)


@contextmanager
def _publishers(job: dict[str, Any], count: int, *, express: bool = False) -> Iterator[Any]:
    """Declare a publisher for each PD; an *express* one does not wait for a batch."""
    words = Page(Path(job["page"])).words
    with _session(job, "connect") as session:
        block = zenoh.CongestionControl.BLOCK
        found = [
            session.declare_publisher(f"{_ROOT}/{n}", congestion_control=block, express=express)
            for n in range(count)
        ]
        while not all(each.matching_status.matching for each in found):
            wait(0.01)
        words[Page.JOINED] = 1
        yield found


@contextmanager
def _subscriber(job: dict[str, Any], take: Any) -> Iterator[None]:
    with _session(job, "listen") as session:
        session.declare_subscriber(f"{_ROOT}/*", take)
        answer({"ready": True})
        yield
