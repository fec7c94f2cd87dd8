"""A poll client and a server, each the engine over one station on an Ethernet interface."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from time import monotonic_ns
from typing import Any

from eap.ids import InterfaceUri, NetId
from eap.net import realtime
from eap.net.ticker import Ticker
from eap.pd.engine import Engine
from eap.pd.quality import tracker_word
from eap.pd.report import station_status
from eap.pd.spec import (
    REQUESTER,
    CounterSource,
    PortKind,
    PortSpec,
    RxPdSpec,
    StationSpec,
    TriggerSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Writer,
)
from eap.pd.words import RxWord
from tools.bench.network import Page
from tools.bench.pacing import answer
from tools.bench.stations import Assembled, assemble

CYCLE_US = 1000
EVERY = 10
"""Cycles between two requests: an answer takes less."""
_CLIENT, _SERVER = "10.134.164.1.1.1", "10.134.164.2.1.1"
_MULTICAST = "01:01:05:04:00:00"
_REQUEST, _FIRST, _SECOND = 70, 71, 72


def ask(job: dict[str, Any]) -> None:
    """Ask in every tenth cycle; tell how many cycles each answer took."""
    with _running(_client(job["interface"]), job) as (made, step):
        words, place = made.file.image.words, made.file.image.layout.rx[0]
        received, trips = 0, []
        end_ns = monotonic_ns() + int(job["seconds"] * 1e9)
        while monotonic_ns() < end_ns:
            step()
            first = tracker_word(made.file.image, place)
            if words[first + RxWord.RECEIVED] != received:
                received = words[first + RxWord.RECEIVED]
                trips.append((words[first + RxWord.ARRIVED_IN_CYCLE] - 1) % EVERY + 1)
        pd = station_status(made.file.image, monotonic_ns())["pd"]
        response_us = pd["rx"][0]["response_us"]
        answer({"trips": trips, "asked": pd["tx"][0]["sent"], "response_us": response_us})


def serve(job: dict[str, Any]) -> None:
    """Answer with two PDs until the page says stop."""
    stop = Page(Path(job["page"])).words
    with _running(_server(job["interface"], job["phase_us"]), job) as (_, step):
        answer({"ready": True})
        while not stop[Page.STOP]:
            step()


@contextmanager
def _running(
    spec: StationSpec, job: dict[str, Any]
) -> Iterator[tuple[Assembled, Callable[[], None]]]:
    """Start the station of *spec*; yield it, and what runs its next cycle when that is due."""
    with assemble(spec, Path(job["folder"]), job["interface"]) as made, closing(Ticker()) as ticker:
        realtime.prepare(job["priority"], [job["cpu"]])
        engine = Engine([made.station])
        engine.start(monotonic_ns())

        def step() -> None:
            if ticker.wait(engine.next_timeout()):
                engine.handle_timeout(monotonic_ns())

        yield made, step


def _client(interface: str) -> StationSpec:
    trigger = TriggerSpec(cycle_us=EVERY * CYCLE_US)
    return StationSpec(
        name="client",
        net_id=NetId.parse("10.134.164.1.9.1"),
        cycle_us=CYCLE_US,
        ports=(
            PortSpec(
                "eap0",
                PortKind.EAP,
                InterfaceUri.parse(f"ethernet://{interface}"),
                NetId.parse(_CLIENT),
            ),
        ),
        variables=(
            VariableSpec("job", "UDINT"),
            *(VariableSpec(name, "UDINT", Writer.ENGINE) for name in ("first", "second")),
        ),
        frames=(
            TxFrameSpec(
                "ask", "eap0", _MULTICAST, (TxPdSpec("request", _REQUEST, ("job",), 0, trigger),)
            ),
        ),
        subscriptions=tuple(
            RxPdSpec(
                name,
                "eap0",
                pd_id,
                (name,),
                _SERVER,
                sender_cycle_us=CYCLE_US,
                poll_request="request",
            )
            for name, pd_id in (("first", _FIRST), ("second", _SECOND))
        ),
    )


def _server(interface: str, phase_us: int) -> StationSpec:
    return StationSpec(
        name="server",
        net_id=NetId.parse("10.134.164.2.9.1"),
        cycle_us=CYCLE_US,
        phase_us=phase_us,
        ports=(
            PortSpec(
                "eap0",
                PortKind.EAP,
                InterfaceUri.parse(f"ethernet://{interface}"),
                NetId.parse(_SERVER),
            ),
        ),
        variables=(
            VariableSpec("job", "UDINT", Writer.ENGINE),
            VariableSpec("count", "UDINT", Writer.ENGINE),
        ),
        sources=(CounterSource("count"),),
        subscriptions=(RxPdSpec("asked", "eap0", _REQUEST, ("job",), _CLIENT),),
        frames=(
            TxFrameSpec(
                "answer",
                "eap0",
                REQUESTER,
                tuple(
                    TxPdSpec(f"pd{pd_id}", pd_id, ("count",), poll_request="asked")
                    for pd_id in (_FIRST, _SECOND)
                ),
            ),
        ),
    )
