"""The other reference: ZeroMQ PUB and SUB over TCP, an EtherCAT frame a message, same octets."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from time import monotonic_ns
from typing import Any

import zmq

from eap.codec.pd import CYCLE_OFFSET, FIRST_PD, PdHeader
from tools.bench.network import Page
from tools.bench.pacing import BURST, answer, send_for, send_stamps, wait
from tools.bench.stations import Shape
from tools.bench.timing import Latencies

_PORT = 5599
_BEGIN = b"begin"
_LOOK_UP_MS = 100
_TELL_EVERY = 32
_CYCLE = struct.Struct("<H")
_STAMP = struct.Struct("<q")
_STAMP_AT = FIRST_PD + PdHeader.SIZE


def send(job: dict[str, Any]) -> None:
    """Patch the counter in one buffer and ``send`` it as a message, again and again."""
    words = Page(Path(job["page"])).words
    buffer, put, cycle = bytearray(Shape(**job["shape"]).frame_size), _CYCLE.pack_into, 0
    with _publisher(job) as sock:
        transmit = sock.send

        def send_burst() -> None:
            nonlocal cycle
            for _ in range(BURST):
                cycle += 1
                put(buffer, CYCLE_OFFSET, cycle & 0xFFFF)
                transmit(buffer)

        arrived = (lambda: words[Page.RECEIVED]) if job["window"] else (lambda: cycle)
        seconds = send_for(job["seconds"], send_burst, arrived)
        answer({"sent": cycle, "seconds": seconds})


def receive(job: dict[str, Any]) -> None:
    """Take each message, unpack the counter and compare it."""
    words = Page(Path(job["page"])).words
    received = lost = last = 0
    with _subscriber(job) as sock:
        take, get = sock.recv, _CYCLE.unpack_from
        while not words[Page.STOP]:
            try:
                while True:
                    (cycle,) = get(take(), CYCLE_OFFSET)
                    lost += cycle - last - 1 & 0xFFFF
                    last = cycle
                    received += 1
                    if not received % _TELL_EVERY:
                        words[Page.RECEIVED] = received
            except zmq.Again:
                words[Page.RECEIVED] = received
    answer({"received": received, "lost": lost})


def send_paced(job: dict[str, Any]) -> None:
    """Send one message a cycle; its data begins with the time just before."""
    buffer, put = bytearray(Shape(**job["shape"]).frame_size), _STAMP.pack_into
    with _publisher(job) as sock:

        def send_at(now_ns: int) -> None:
            put(buffer, _STAMP_AT, now_ns)
            sock.send(buffer)

        send_stamps(job["seconds"], send_at)


def receive_stamps(job: dict[str, Any]) -> None:
    """Block in ``recv``; note when it returns."""
    words, latencies = Page(Path(job["page"])).words, Latencies()
    get = _STAMP.unpack_from
    with _subscriber(job) as sock:
        while not words[Page.STOP]:
            with suppress(zmq.Again):
                while True:
                    (sent_ns,) = get(sock.recv(), _STAMP_AT)
                    latencies.enter(monotonic_ns() - sent_ns)
    answer(latencies.summary())


@contextmanager
def _publisher(job: dict[str, Any]) -> Iterator[Any]:
    """Open a socket that a subscriber hears."""
    words = Page(Path(job["page"])).words
    with zmq.Context() as context, context.socket(zmq.PUB) as sock:
        if job["window"]:  # without one it is a socket as it comes, which drops what is too much
            sock.setsockopt(zmq.SNDHWM, 0)
        sock.setsockopt(zmq.LINGER, 0)
        sock.bind(f"tcp://{job['address']}:{_PORT}")
        while not words[Page.JOINED]:  # a subscription takes a moment to get through
            sock.send(b"")
            wait(0.001)
        sock.send(_BEGIN)
        yield sock


@contextmanager
def _subscriber(job: dict[str, Any]) -> Iterator[Any]:
    """Open a socket that has joined the publisher; answer before that one starts."""
    words = Page(Path(job["page"])).words
    with zmq.Context() as context, context.socket(zmq.SUB) as sock:
        if job["window"]:
            sock.setsockopt(zmq.RCVHWM, 0)
        sock.setsockopt(zmq.LINGER, 0)
        sock.setsockopt(zmq.SUBSCRIBE, b"")
        sock.connect(f"tcp://{job['address']}:{_PORT}")
        answer({"ready": True})
        while sock.recv() != _BEGIN:
            words[Page.JOINED] = 1
        sock.setsockopt(zmq.RCVTIMEO, _LOOK_UP_MS)
        yield sock
