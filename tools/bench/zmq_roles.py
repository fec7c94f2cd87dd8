"""The other reference: ZeroMQ PUB and SUB over TCP, an EtherCAT frame a message, same octets."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import zmq

from eap.codec.pd import CYCLE_OFFSET
from tools.bench.network import Page
from tools.bench.pacing import BURST, answer, send_for, wait
from tools.bench.stations import Shape

_PORT = 5599
_BEGIN = b"begin"
_LOOK_UP_MS = 100
_TELL_EVERY = 32
_CYCLE = struct.Struct("<H")


def publish(job: dict[str, Any]) -> None:
    """Patch the counter in one buffer and ``send`` it as a message, again and again."""
    words = Page(Path(job["page"])).words
    buffer, put, cycle = bytearray(Shape(**job["shape"]).frame_size), _CYCLE.pack_into, 0
    with zmq.Context() as context, context.socket(zmq.PUB) as sock:
        if job["window"]:  # without one it is a socket as it comes, which drops what is too much
            sock.setsockopt(zmq.SNDHWM, 0)
        sock.setsockopt(zmq.LINGER, 0)
        sock.bind(f"tcp://{job['address']}:{_PORT}")
        while not words[Page.JOINED]:  # a subscription takes a moment to get through
            sock.send(b"")
            wait(0.001)
        sock.send(_BEGIN)
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


def subscribe(job: dict[str, Any]) -> None:
    """Take each message, unpack the counter and compare it."""
    words = Page(Path(job["page"])).words
    received = lost = last = 0
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
