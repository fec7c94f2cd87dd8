"""The product as publisher and as subscriber: its stations on an Ethernet interface.

Nothing here stands between the station and the wire; frames are counted by the counters that
``eapctl status`` shows.
"""

from __future__ import annotations

import struct
from pathlib import Path
from time import monotonic_ns
from typing import Any

from eap.net.image_file import open_image
from eap.net.ticker import Ticker
from eap.pd.engine import Engine
from eap.pd.quality import tracker_word
from eap.pd.words import RxWord
from tools.bench.network import Page
from tools.bench.pacing import BURST, answer, send_for
from tools.bench.stations import (
    CYCLE_US,
    Shape,
    assemble,
    frames_received,
    frames_sent,
    publishing,
    subscribing,
)
from tools.bench.timing import Latencies

_CYCLES_BETWEEN_LOOKS = 64
_STAMP = struct.Struct("<q")


def publish(job: dict[str, Any]) -> None:
    """Run the cycle of the publishing station, again and again."""
    shape, folder = Shape(**job["shape"]), Path(job["folder"])
    spec = publishing(shape, job["interface"])
    with (
        assemble(spec, folder, job["interface"]) as made,
        open_image(folder / "subscriber.image") as far,
    ):
        place, words, cycle = far.image.layout.rx[-1], far.image.words, made.station.cycle
        made.station.start(monotonic_ns())
        cycles = range(BURST // shape.frames)

        def send_burst() -> None:
            for _ in cycles:
                now_ns = monotonic_ns()
                cycle(now_ns, now_ns)

        def arrived() -> int:
            first = tracker_word(far.image, place)
            return int(words[first + RxWord.RECEIVED]) * shape.frames

        seconds = send_for(job["seconds"], send_burst, arrived)
        answer({"sent": frames_sent(made.file.image), "seconds": seconds})


def subscribe(job: dict[str, Any]) -> None:
    """Run the cycle of the subscribing station, again and again."""
    shape, stop = Shape(**job["shape"]), Page(Path(job["page"])).words
    spec = subscribing(shape, job["interface"])
    with assemble(spec, Path(job["folder"]), job["interface"]) as made:
        cycle = made.station.cycle
        made.station.start(monotonic_ns())
        answer({"ready": True})
        while not stop[Page.STOP]:
            for _ in range(_CYCLES_BETWEEN_LOOKS):
                now_ns = monotonic_ns()
                cycle(now_ns, now_ns)
        received, lost = frames_received(made.file.image, shape)
        answer({"received": received, "lost": lost})


def publish_paced(job: dict[str, Any]) -> None:
    """Send one frame a cycle; its data begins with the time just before that cycle."""
    shape = Shape(**job["shape"])
    spec = publishing(shape, job["interface"])
    with assemble(spec, Path(job["folder"]), job["interface"]) as made:
        image, ticker, put = made.file.image, Ticker(), _STAMP.pack_into
        offset = image.layout.variables[0].bit_offset // 8
        due_ns = made.station.start(monotonic_ns())
        for _ in range(int(job["seconds"] * 1e6 / CYCLE_US)):
            while not ticker.wait(due_ns):
                pass
            now_ns = monotonic_ns()
            put(image.memory, offset, now_ns)
            made.station.cycle(due_ns, now_ns)
            due_ns += CYCLE_US * 1000
        answer({"sent": frames_sent(image)})


def subscribe_on_arrival(job: dict[str, Any]) -> None:
    """Run an engine whose port wakes on arrival; note when the data stands in the image."""
    shape, stop = Shape(**job["shape"]), Page(Path(job["page"])).words
    spec = subscribing(shape, job["interface"])
    with assemble(spec, Path(job["folder"]), job["interface"]) as made:
        engine, latencies = Engine([made.station]), Latencies()
        ticker = Ticker(spins=job["batch"] == 0)
        engine.drain_on_arrival([made.channel])
        ticker.register(made.channel.fileno())
        memory, get = made.file.image.memory, _STAMP.unpack_from
        offset = made.file.image.layout.variables[0].bit_offset // 8
        before = 0
        engine.start(monotonic_ns())
        answer({"ready": True})
        while not stop[Page.STOP]:
            if ticker.wait(engine.next_timeout()):
                engine.handle_timeout(monotonic_ns())
            else:
                engine.receive(monotonic_ns())
            (sent_ns,) = get(memory, offset)
            if sent_ns != before:
                latencies.enter(monotonic_ns() - sent_ns)
                before = sent_ns
        ticker.close()
        answer(latencies.summary())
