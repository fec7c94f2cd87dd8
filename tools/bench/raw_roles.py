"""The reference: the smallest loop over a raw socket that Python can do, same octets."""

from __future__ import annotations

import socket
import struct
from pathlib import Path
from time import monotonic_ns, process_time_ns
from typing import Any

from eap.codec.ethercat import ETHERTYPE
from eap.codec.pd import CYCLE_OFFSET, FIRST_PD, PdHeader
from eap.net.ticker import Ticker
from tools.bench.network import Page
from tools.bench.pacing import BURST, answer, send_for, send_stamps
from tools.bench.stations import ETHERNET_HEADER, Shape, frame_octets
from tools.bench.timing import Latencies

_RECEIVE_BUFFER = 8 << 20
_SO_RCVBUFFORCE = 33
_LOOK_UP_US = 100_000
_TELL_EVERY = 32
_CYCLE = struct.Struct("<H")
_CYCLE_AT = ETHERNET_HEADER + CYCLE_OFFSET
_STAMP = struct.Struct("<q")
_STAMP_AT = ETHERNET_HEADER + FIRST_PD + PdHeader.SIZE


def send(job: dict[str, Any]) -> None:
    """Patch the counter in one buffer and ``send`` it, again and again."""
    words = Page(Path(job["page"])).words
    buffer, put, cycle = bytearray(frame_octets(Shape(**job["shape"]))), _CYCLE.pack_into, 0
    with _open(job["interface"]) as sock:
        transmit = sock.send

        def send_burst() -> None:
            nonlocal cycle
            for _ in range(BURST):
                cycle += 1
                put(buffer, _CYCLE_AT, cycle & 0xFFFF)
                transmit(buffer)

        seconds = send_for(job["seconds"], send_burst, lambda: words[Page.RECEIVED])
    answer({"sent": cycle, "seconds": seconds})


def receive(job: dict[str, Any]) -> None:
    """``recv_into`` one buffer, unpack the counter and compare it."""
    words = Page(Path(job["page"])).words
    buffer, get, received, lost, last = bytearray(2048), _CYCLE.unpack_from, 0, 0, 0
    with _open(job["interface"]) as sock:
        take = sock.recv_into
        answer({"ready": True})
        while not words[Page.STOP]:
            try:
                while True:
                    take(buffer)
                    (cycle,) = get(buffer, _CYCLE_AT)
                    lost += cycle - last - 1 & 0xFFFF
                    last = cycle
                    received += 1
                    if not received % _TELL_EVERY:
                        words[Page.RECEIVED] = received
            except BlockingIOError:
                words[Page.RECEIVED] = received
    answer({"received": received, "lost": lost})


def send_paced(job: dict[str, Any]) -> None:
    """Send one frame a cycle; its data begins with the time just before."""
    buffer, put = bytearray(frame_octets(Shape(**job["shape"]))), _STAMP.pack_into
    with _open(job["interface"]) as sock:

        def send_at(now_ns: int) -> None:
            put(buffer, _STAMP_AT, now_ns)
            sock.send(buffer)

        send_stamps(job["seconds"], send_at)


def receive_stamps(job: dict[str, Any]) -> None:
    """Block in ``recv_into``; note when it returns."""
    words, latencies = Page(Path(job["page"])).words, Latencies()
    buffer, get = bytearray(2048), _STAMP.unpack_from
    with _open(job["interface"]) as sock:
        take = sock.recv_into
        answer({"ready": True})
        while not words[Page.STOP]:
            try:
                while True:
                    take(buffer)
                    (sent_ns,) = get(buffer, _STAMP_AT)
                    latencies.enter(monotonic_ns() - sent_ns)
            except BlockingIOError:
                continue
    answer(latencies.summary())


def wake(job: dict[str, Any]) -> None:
    """Wake for each cycle and do nothing; tell the share of a core."""
    ticker, cycle_ns = Ticker(), job["cycle_us"] * 1000
    begin_ns = due_ns = monotonic_ns()
    used_ns = process_time_ns()
    while due_ns < begin_ns + job["seconds"] * 1e9:
        due_ns += cycle_ns
        while not ticker.wait(due_ns):
            pass
    answer({"cpu": (process_time_ns() - used_ns) / (monotonic_ns() - begin_ns)})


def _open(interface: str) -> socket.socket:
    sock = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(ETHERTYPE))
    sock.bind((interface, ETHERTYPE))
    sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _RECEIVE_BUFFER)
    # So long a blocking receiver sleeps before it looks whether it shall end.
    patience = struct.pack("@ll", 0, _LOOK_UP_US)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, patience)
    return sock
