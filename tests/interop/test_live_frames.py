"""tshark listens while appliances publish: it sees the frames that they say they sent.

The plants carry several PDs a frame, several frames a station and all rhythms that are known
beforehand; what tshark reads is compared with the plant file, with our counters, with what
``eapctl pd watch`` printed meanwhile and with our own decoder.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import pytest

from eap.codec.pd import PdFrameHeader
from eap.ids import NetId
from eap.ops.decode import decode_frame
from eap.recording.packets import iter_capture
from tests.support.appliance import Plants, plants, wait_until
from tests.support.namespaces import cable, namespace
from tests.support.tshark import dissect

pytestmark = [pytest.mark.net, pytest.mark.root, pytest.mark.tshark]

FILTER = "port 34980 or ether proto 0x88a4 or (vlan and ether proto 0x88a4)"
PUBLISHER = "10.9.8.1.2.1"
MOST_LEFT_OUT = 1000
"""Cycles that the sender's engine may leave out while it runs."""
DATA_SIZE = {1: 4 + 2 + 32, 2: 4, 3: 600, 9: 4}
PLANT = """\
plant: live
defaults: {cycle_us: 10000}
stations:
  - name: source
    net_id: 10.9.8.1.1.1
    ports:
      - {name: eap0, kind: eap, interface: "SOURCE", net_id: 10.9.8.1.2.1PORT}
    variables:
      ticks: UDINT
      setpoint: {type: UINT, default: 513}
      text: {type: STRING(32), default: "all well"}
      noise: BLOCK(600)
    sources:
      ticks: {kind: counter}
      noise: {kind: random, seed: 3}
    frames:
      - {name: one, port: eap0, to: "DESTINATION"}
      - {name: two, port: eap0, to: "DESTINATION", divider: 2}
    publish:
      - {name: state, frame: one, id: 1, version: 11, variables: [ticks, setpoint, text]}
      - {name: slow, frame: one, id: 2, version: 12, variables: [ticks], cycle_us: 50000}
      - {name: bulk, frame: one, id: 3, version: 13, variables: [noise]}
      - {name: half, frame: two, id: 9, version: 19, variables: [ticks]}
  - name: sink
    net_id: 10.9.8.2.1.1
    ports:
      - {name: eap0, kind: eap, interface: "SINK", net_id: 10.9.8.2.2.1PORTTCP}
    subscribe:
      - {name: state, port: eap0, from: source/state, timeout_ms: 500}
      - {name: bulk, port: eap0, from: source/bulk, timeout_ms: 500}
      - {name: half, port: eap0, from: source/half, timeout_ms: 500}
"""


class Endpoint:
    """One way for frames to go, and where to listen."""

    def __init__(self, source: str, sink: str, to: str, *, port: str = "", tcp: str = "") -> None:
        plant = PLANT.replace("SOURCE", source).replace("SINK", sink).replace("DESTINATION", to)
        self.plant = plant.replace("PORTTCP", port + tcp).replace("PORT", port)
        self.needs_cable = not source.startswith("udp://127.")
        self.transport = "tcp" if tcp else source.partition(":")[0]


ETHERNET, HERE, THERE = "ethernet://line0", "udp://127.9.8.1", "udp://127.9.8.2"
WAYS = {
    "ethernet": Endpoint(ETHERNET, ETHERNET, "multicast"),
    "ethernet-broadcast": Endpoint(ETHERNET, ETHERNET, "broadcast"),
    "vlan": Endpoint(ETHERNET, ETHERNET, "multicast", port=", vlan: {id: 7, priority: 5}"),
    "udp": Endpoint(HERE, THERE, "127.9.8.2"),
    "udp-multicast": Endpoint(HERE, THERE, "239.9.8.1"),
    "udp-broadcast": Endpoint("udp://10.88.164.1", "udp://10.88.164.2", "broadcast"),
    "tcp": Endpoint(HERE, THERE, "tcp://127.9.8.2", tcp=", tcp: true"),
}


@contextmanager
def capture(path: Path, interface: str, prefix: Sequence[str]) -> Iterator[None]:
    """Let tshark write what passes *interface* while the block runs."""
    command = ["tshark", "-n", "-i", interface, "-f", FILTER, "-w", str(path)]
    with subprocess.Popen(
        [*prefix, *command], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        try:
            for line in process.stderr:
                if line.startswith("Capturing on"):
                    break
            yield
        finally:
            process.terminate()
            process.communicate(timeout=10)


def run_both(
    farm: Plants, way: Endpoint, path: Path, prefixes: Sequence[Sequence[str]]
) -> tuple[list[dict[str, Any]], dict[str, Any], list[dict[str, Any]]]:
    """Run sink and source for some 100 cycles; return PDs sent, PDs received, what was watched."""
    plant = farm.write(way.plant)
    interface = "line0" if way.needs_cable else "lo"
    with capture(path, interface, prefixes[1]):
        sink = farm.run(plant, "--station", "sink", prefix=prefixes[1])
        source = farm.run(plant, "--station", "source", prefix=prefixes[0])
        wait_until(lambda: sink.rx("sink", "state")["received"] > 30)
        source.command("pd", "set", "source", "setpoint", "4711")
        words = ["pd", "watch", "sink", "state.ticks", "state.setpoint", "--count", "8", "--json"]
        watched = [json.loads(line) for line in sink.command(*words).splitlines()]
        wait_until(lambda: sink.values("sink")["state.setpoint"] == 4711)
        wait_until(lambda: sink.rx("sink", "state")["received"] > 100)
        source.command("state", "source", "PREOP")  # where it sends nothing more
        sent = {name: source.tx("source", name) for name in ("state", "slow", "bulk", "half")}
        assert source.stop()[0] == 0
        received = sink.station("sink")["pd"]["rx"]
        (last,) = (rx["cycle_index"] for rx in received if rx["name"] == "state")
        ends = [frame_start(count, last) for count in (2, 3)]  # tshark writes when it likes to
        wait_until(lambda: any(end in path.read_bytes() for end in ends))
    return watched, sent, received


def frame_start(count: int, cycle: int) -> bytes:
    return PdFrameHeader(NetId.parse(PUBLISHER), count, cycle).encode()


@pytest.fixture
def farm() -> Iterator[Plants]:
    with plants() as folder:
        yield folder


@pytest.mark.parametrize("name", WAYS)
def test_tshark_decodes_the_frames_of_appliances(name: str, farm: Plants, tmp_path: Path) -> None:
    way, path = WAYS[name], tmp_path / "live.pcap"
    if way.needs_cable:
        with cable(addresses=True) as ends:
            watched, sent, received = run_both(farm, way, path, [end.prefix for end in ends])
    else:
        with namespace() as alone:
            watched, sent, received = run_both(farm, way, path, [alone.prefix] * 2)
    everything = dissect(path)
    assert not any(frame["malformed"] for frame in everything)
    frames = [frame for frame in everything if frame["type"] == 4]  # routers ask each other by 5
    assert {frame["transport"] for frame in frames} == {way.transport}
    if name == "vlan":
        tags = {
            (f["layers"]["vlan"]["vlan.id"], f["layers"]["vlan"]["vlan.priority"]) for f in frames
        }
        assert tags == {("7", "5")}
    assert_same_as_our_decoder(frames, path)
    assert_as_planned(frames)
    assert_counted(frames, sent, received)
    assert_watched(frames, watched)


def assert_same_as_our_decoder(frames: list[dict[str, Any]], path: Path) -> None:
    everything = [
        msgspec.to_builtins(decode_frame(captured.data)) for captured in iter_capture(path)
    ]
    ours = [frame for frame in everything if frame["type"] == 4]
    assert len(ours) == len(frames)
    for found, expected in zip(frames, ours, strict=True):
        assert expected.pop("error") is None
        assert {name: found[name] for name in expected} == expected


def assert_as_planned(frames: list[dict[str, Any]]) -> None:
    """Publisher, ids, versions, lengths, quality, rhythm and the octets themselves."""
    ahead = []
    for frame in frames:
        assert (frame["type"], frame["publisher"]) == (4, PUBLISHER)
        assert frame["count"] == len(frame["pds"])
        assert frame["length"] == 12 + sum(8 + pd["length"] for pd in frame["pds"])
        for pd in frame["pds"]:
            assert pd["version"] == pd["id"] + 10
            assert (pd["length"], pd["quality"]) == (DATA_SIZE[pd["id"]], 0)
            if pd["id"] != 3:
                ticks = int.from_bytes(bytes.fromhex(pd["data"])[:4], "little")
                ahead.append((ticks - frame["cycle"]) & 0xFFFF)
    # What counts goes on in cycles that a busy machine leaves out, and never back.
    assert ahead == sorted(ahead)
    assert ahead[-1] < MOST_LEFT_OUT
    steps = {1: 1, 2: 5, 3: 1, 9: 2}
    for pd_id, step in steps.items():
        cycles = [f["cycle"] for f in frames if any(pd["id"] == pd_id for pd in f["pds"])]
        assert cycles == list(range(cycles[0], cycles[-1] + 1, step))
    noise = [pd["data"] for f in frames for pd in f["pds"] if pd["id"] == 3]
    assert len(set(noise)) == len(noise)


def assert_counted(
    frames: list[dict[str, Any]], sent: dict[str, Any], received: list[dict[str, Any]]
) -> None:
    """As many as we said we had sent, and as many as the other end took."""
    seen = [pd["id"] for frame in frames for pd in frame["pds"]]
    for name, pd_id in (("state", 1), ("slow", 2), ("bulk", 3), ("half", 9)):
        assert seen.count(pd_id) == sent[name]["sent"]
    for rx in received:
        pd_id = {"state": 1, "bulk": 3, "half": 9}[rx["name"]]
        assert rx["lost"] == 0
        assert 0 <= seen.count(pd_id) - rx["received"] <= 1  # the last one waits for no cycle


def assert_watched(frames: list[dict[str, Any]], watched: list[dict[str, Any]]) -> None:
    """Every value that a person saw on the far side passed the wire, and the new one did, too."""
    data = [bytes.fromhex(pd["data"]) for f in frames for pd in f["pds"] if pd["id"] == 1]
    ticks = {int.from_bytes(octets[:4], "little") for octets in data}
    setpoints = [int.from_bytes(octets[4:6], "little") for octets in data]
    assert {octets[6:14] for octets in data} == {b"all well"}
    assert set(setpoints) == {513, 4711}
    assert sorted(setpoints) == setpoints
    shown = [row["value"] for row in watched if row["variable"] == "state.ticks"]
    assert len(shown) >= 5
    assert set(shown) <= ticks
