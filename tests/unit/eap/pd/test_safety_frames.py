"""Frames of a safety protocol as blocks: a black channel over two hops, as docs/safety.md says."""

from __future__ import annotations

import re
import zlib
from itertools import pairwise
from pathlib import Path
from random import Random

import pytest

from eap.config.index import ExpectedBus
from eap.config.load import load
from eap.ids import InterfaceUri
from eap.net.loopback import LoopbackChannel, LoopbackLines
from eap.pd.engine import Engine
from eap.pd.image import Image
from eap.pd.report import station_status
from eap.pd.spec import (
    LinkSpec,
    RxPdSpec,
    StationSpec,
    Substitute,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Writer,
)
from eap.pd.station import Station
from tests.support.cyclic import PEER, eap_port, image_of, received, station

RELAY = "1.2.3.4.9.1"


class Line:
    """A safety controller, a relay and a safety drive: blocks from the first to the last.

    Args:
        size: Bytes of a block.
        options: Faults of both lines.
        substitute: Of the drive's subscription.
    """

    def __init__(
        self, size: int, options: str = "", substitute: Substitute = Substitute.HOLD
    ) -> None:
        self.size = size
        self._random = Random(size)
        self._number = 0
        self.sent: list[bytes] = []
        lines = LoopbackLines()
        times = {"sender_cycle_us": 1000, "step": 1, "timeout_ms": 20, "substitute": substitute}
        block = f"BLOCK({size})"
        specs = (
            self._sender("controller", "safe", PEER, (VariableSpec("safe", block),)),
            self._relay(block, times),
            station(
                "drive",
                phase_us=600,
                variables=received(f"safe:{block}"),
                subscriptions=(RxPdSpec("r", "eap0", 7, ("safe",), RELAY, **times),),
            ),
        )
        self.images: list[Image] = []
        self.channels: list[LoopbackChannel] = []
        stations = []
        for spec in specs:
            self.images.append(image_of(spec))
            made = Station(spec, self.images[-1], lambda: None)
            for port in spec.ports:
                name = "far" if spec.name == "drive" or port.name == "eap1" else "near"
                channel = lines.open(InterfaceUri.parse(f"loop://{name}{options}"))
                channel.handlers.append(made.handlers[port.name])
                made.connect(port.name, channel)
                self.channels.append(channel)
            stations.append(made)
        self._engine = Engine(stations)
        self._engine.start(0)

    def _sender(
        self, name: str, variable: str, net_id: str, variables: tuple[VariableSpec, ...]
    ) -> StationSpec:
        frame = TxFrameSpec("f", "eap0", "10.0.0.1", (TxPdSpec("p", 7, (variable,)),))
        return station(
            name, ports=(eap_port("eap0", net_id),), variables=variables, frames=(frame,)
        )

    def _relay(self, block: str, times: dict[str, object]) -> StationSpec:
        frame = TxFrameSpec("f", "eap1", "10.0.0.1", (TxPdSpec("p", 7, ("copy",)),))
        return station(
            "relay",
            phase_us=300,
            ports=(eap_port("eap0"), eap_port("eap1", RELAY)),
            variables=(*received(f"safe:{block}"), VariableSpec("copy", block, Writer.ENGINE)),
            links=(LinkSpec("safe", "copy"),),
            frames=(frame,),
            subscriptions=(RxPdSpec("r", "eap0", 7, ("safe",), PEER, **times),),
        )

    def send(self) -> None:
        """Have the controller make its next frame: a number, data, and a checksum over both."""
        self._number += 1
        body = self._number.to_bytes(4, "little") + self._random.randbytes(self.size - 8)
        frame = body + zlib.crc32(body).to_bytes(4, "little")
        self.sent.append(frame)
        with self.images[0].writing(Writer.APPLICATION):
            self.images[0].store("safe", frame)

    def run(self, cycles: int) -> None:
        for _ in range(3 * cycles):
            self._engine.handle_timeout(self._engine.next_timeout())

    @property
    def taken(self) -> bytes:
        value: bytes = self.images[-1].read("safe")
        return value

    @property
    def row(self) -> dict[str, object]:
        row: dict[str, object] = station_status(self.images[-1], 0)["pd"]["rx"][0]
        return row


def test_plant_of_the_page_has_no_errors(tmp_path: Path) -> None:
    page = (Path(__file__).parents[4] / "docs" / "safety.md").read_text()
    (example,) = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    file = tmp_path / "guard.yaml"
    file.write_text(example)
    assert load(file, lambda path: ExpectedBus()).findings == ()


@pytest.mark.parametrize("size", [31, 32, 255, 1400])
@pytest.mark.parametrize(
    "options", ["", "?loss=0.1&duplicate=0.1&reorder=0.1&delay_us=1700&seed=4"]
)
def test_blocks_arrive_whole_unchanged_and_in_order(size: int, options: str) -> None:
    line = Line(size, options)
    arrived: list[bytes] = []
    for _ in range(400):
        line.send()
        line.run(1)
        if any(line.taken):
            arrived.append(line.taken)
    assert set(arrived) <= set(line.sent)
    numbers = [line.sent.index(each) for each in arrived]
    assert all(before <= after for before, after in pairwise(numbers))
    assert len(set(numbers)) > (390 if not options else 200)


@pytest.mark.parametrize(
    ("substitute", "is_zero"), [(Substitute.HOLD, False), (Substitute.ZERO, True)]
)
def test_cut_line_is_never_taken_for_new_frames(substitute: Substitute, *, is_zero: bool) -> None:
    line = Line(31, substitute=substitute)
    for _ in range(20):
        line.send()
        line.run(1)
    last, near = line.taken, line.channels[1]
    near.handlers, kept = [], near.handlers
    qualities = []
    for _ in range(60):
        line.send()
        line.run(1)
        # The relay goes on sending, so the drive's own subscription is never late; what it gets is
        # the substitute of the relay, and the age since the line was cut.
        assert line.taken == last or (is_zero and not any(line.taken))
        qualities.append(line.row["quality"])
    assert any(line.taken) is not is_zero
    assert qualities[0] < 30  # type: ignore[operator]
    assert qualities[-1] > 500  # type: ignore[operator]
    assert all(before <= after for before, after in pairwise(qualities))  # type: ignore[operator]
    near.handlers = kept
    for _ in range(5):
        line.send()
        line.run(1)
    assert line.taken in line.sent[-4:]
    # Cut behind the relay: after the time-out there is the substitute.
    line.channels[-1].handlers = []
    last = line.taken
    line.run(60)
    assert line.taken == (bytes(31) if is_zero else last)
    assert line.row["state"] == "stale"
