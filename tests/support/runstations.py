"""Stations that run without processes: with a wire, and configured anew between two cycles."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from eap.codec.pd import iter_pds
from eap.ids import InterfaceUri
from eap.pd.handover import ImageHandover
from eap.pd.image import Image
from eap.pd.link import OutFrame
from eap.pd.spec import (
    OnChangeSpec,
    RxPdSpec,
    StationSpec,
    Substitute,
    TriggerSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Writer,
)
from eap.pd.station import Station
from eap.pd.words import StationWord
from tests.support.cyclic import (
    PEER,
    Wire,
    eap_port,
    image_of,
    station,
    written,
)


class Watched(Wire):
    """A wire that notes whether the engine's variables were marked as changing."""

    image: Image

    def drain(self, now_ns: int) -> int:
        count = super().drain(now_ns)
        self.log.append("changing" if self.image.words[StationWord.ENGINE_SEQUENCE] % 2 else "calm")
        return count

    def send(self, frames: Sequence[OutFrame], now_ns: int) -> Sequence[OutFrame]:
        self.log.append("changing" if self.image.words[StationWord.ENGINE_SEQUENCE] % 2 else "calm")
        return super().send(frames, now_ns)


def assemble(spec: StationSpec, image: Image | None = None) -> tuple[Station, Watched]:
    wire = Watched()
    wire.image = image or image_of(spec)
    made = Station(spec, wire.image, lambda: wire.log.append("wake"))
    wire.handlers.append(made.handlers["eap0"])
    made.connect("eap0", wire)
    return made, wire


def addressed() -> StationSpec:
    """Sends to a port whose address it learns, and to one address."""
    port = msgspec.structs.replace(eap_port(), interface=InterfaceUri.parse("ethernet://eth0"))
    pds = (TxPdSpec("p", 1, ("x",)), TxPdSpec("q", 2, ("x",)))
    return station(
        ports=(port,),
        variables=written("x:UINT"),
        frames=(
            TxFrameSpec("by-id", "eap0", PEER, pds[:1]),
            TxFrameSpec("by-mac", "eap0", "02:00:00:00:00:05", pds[1:]),
        ),
    )


def moody() -> StationSpec:
    """Sends by change, by event, and what asks; receives answers and something with a time-out."""
    return station(
        variables=(
            *written("x:UINT", "y:UINT"),
            *(VariableSpec(name, "UINT", Writer.ENGINE) for name in ("a", "r")),
        ),
        frames=(
            TxFrameSpec(
                "f",
                "eap0",
                "10.0.0.1",
                (
                    TxPdSpec("change", 1, ("x",), trigger=TriggerSpec(on_change=OnChangeSpec())),
                    TxPdSpec("event", 2, ("y",), trigger=TriggerSpec(event=True)),
                ),
            ),
            TxFrameSpec("q", "eap0", "10.0.0.1", (TxPdSpec("ask", 3, ("y",)),)),
        ),
        subscriptions=(
            RxPdSpec("answer", "eap0", 4, ("a",), PEER, poll_request="ask"),
            RxPdSpec("in", "eap0", 7, ("r",), PEER, timeout_ms=3, substitute=Substitute.ZERO),
        ),
    )


def sent_ids(wire: Watched) -> list[int]:
    """Return what was sent since the last look."""
    ids = sorted(pd.pd_id for frame in wire.sent for pd, _ in iter_pds(frame))
    wire.sent.clear()
    return ids


def set_value(image: Image, name: str, value: int) -> None:
    with image.writing(Writer.APPLICATION):
        image.write(name, value)


def succeed(before: Station, spec: StationSpec) -> Station:
    """Configure a station anew between two cycles, as the engine does."""
    images = ImageHandover(before.image, image_of(spec))
    images.carry_words()
    after = Station(spec, images._new, lambda: None)
    after.prepare_handover(before)
    images.commit()
    images.carry_words()
    after.follow(before, 0)
    return after


def succeed_with_values(before: Station, spec: StationSpec, now_ns: int = 0) -> Station:
    """Configure a station anew, its variables included."""
    image = image_of(spec)
    images = ImageHandover(before.image, image)
    images.carry_words()
    images.carry_values(before.inputs.memory)
    after = Station(spec, image, lambda: None)
    after.prepare_handover(before)
    images.commit()
    images.carry_words()
    before.inputs.refresh()
    images.carry_values(before.inputs.memory)
    after.follow(before, now_ns)
    return after
