"""``eapctl discover`` beside the solar line: 54 PDs, and the written plant receives all of them."""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import dpkt
import pytest

from eap.codec.ethercat import EtherCatHeader, FrameType
from eap.codec.pd import PdFrameHeader, PdHeader, encode_frame
from eap.ids import NetId
from eap.net import interface
from eap.net.capture import FrameCapture
from eap.recording.packets import iter_capture
from tests.support.appliance import (
    EAPCTL,
    Appliance,
    Plants,
    SharedAppliance,
    run_eapctl,
    troubles,
    wait_until,
)
from tests.support.namespaces import Namespace, cable, enter, enter_network, namespace
from tests.support.pages import ROOT, Shell, commands, shell

pytestmark = [pytest.mark.net, pytest.mark.root]

SOLAR_LINE = ROOT / "config/solar-line.yaml"
CAPTURED = 54 * 100
"""Packets of the capture: a second of the line."""


@pytest.fixture(scope="module")
def line_network() -> Iterator[Namespace]:
    with namespace() as inside:
        yield inside


@pytest.fixture(scope="module")
def shared(module_farm: Plants, line_network: Namespace) -> SharedAppliance:
    return SharedAppliance(lambda: module_farm.run(SOLAR_LINE, prefix=line_network.prefix))


@pytest.fixture
def line(shared: SharedAppliance) -> Appliance:
    return shared.running()


def forget_kernel_socket() -> None:
    """Close the socket that questions about interfaces go to: it belongs to another network."""
    interface._kernel().close()
    interface._kernel.cache_clear()


@contextmanager
def inside(network: Namespace) -> Iterator[None]:
    """Take the test into *network* for the length of a block."""
    with Path("/proc/thread-self/ns/net").open() as home:
        enter(network)
        forget_kernel_socket()
        try:
            yield
        finally:
            enter_network(home.fileno())
            forget_kernel_socket()


def record(path: Path) -> None:
    """Write a second of what passes lo into a pcap file."""
    with closing(FrameCapture("lo")) as capture, path.open("wb") as file:
        writer = dpkt.pcap.Writer(file, snaplen=65535, nano=True)
        seen = 0

        def write(octets: memoryview, at_ns: int, tci: int) -> None:
            nonlocal seen
            seen += 1
            writer.writepkt_time(bytes(octets), at_ns / 1e9)

        while seen < CAPTURED:
            capture.drain(write)
            time.sleep(0.001)
        assert capture.dropped == 0


@pytest.fixture(scope="module")
def capture(shared: SharedAppliance, line_network: Namespace, module_farm: Plants) -> Path:
    shared.running()
    path = module_farm.folder / "line.pcap"
    with inside(line_network):
        record(path)
    return path


def discover(runtime: Path, *words: object) -> list[dict[str, Any]]:
    result = run_eapctl(runtime, "discover", *map(str, words), "--json")
    assert result.returncode == 0, result.stderr
    return [json.loads(row) for row in result.stdout.splitlines()]


def test_all_pds_are_found_beside_the_running_line(
    line: Appliance, line_network: Namespace
) -> None:
    with inside(line_network):
        rows = discover(line.runtime, "lo", "--for", 1.5)
    assert len(rows) == 54
    assert {row["trigger"] for row in rows} == {"cycle"}
    assert {row["period_ms"] for row in rows} == {10}
    subscriptions = {
        f"{station['name']}/{rx['name']}"
        for station in line.status()["stations"]
        for rx in station["pd"]["rx"]
    }
    assert {row["taken_by"] for row in rows} == subscriptions


def test_all_pds_are_found_in_a_capture(capture: Path, tmp_path: Path) -> None:
    rows = discover(tmp_path, "--pcap", capture, "--plant", SOLAR_LINE)
    assert len(rows) == 54
    assert all(row["taken_by"] for row in rows)


def test_dictionaries_of_publishers_give_names_and_types(
    line: Appliance, line_network: Namespace, tmp_path: Path
) -> None:
    target = tmp_path / "found.yaml"
    publishers = ("127.0.1.100.2.1", "127.0.1.2.2.1")
    asked = [word for each in publishers for word in ("--from", each)]
    with inside(line_network):
        rows = discover(line.runtime, "lo", "--for", 1, *asked, "--write", target)
    named = [row for row in rows if row["publisher"] in publishers]
    assert len(named) == 14 + 3
    assert all(row["name"] and row["rate_hz"] for row in named)
    assert [each["name"] for each in named[0]["variables"]] == ["pieces", "temperature", "belt"]
    result = run_eapctl(tmp_path, "check", str(target))
    assert "54 PDs received" in result.stdout
    assert '"report-127.0.1.2.2.1.position": REAL' in target.read_text()


def test_dictionary_alone_lists_pds_that_were_not_seen(line: Appliance) -> None:
    rows = discover(line.runtime, "--from", "127.0.1.1.2.1")
    assert [(row["pd_id"], row["name"], row["received"]) for row in rows] == [
        (2, "to-right", 0),
        (3, "report", 0),
    ]
    assert [row["taken_by"] for row in rows] == ["island-02/left", "control/island-01"]
    unknown = run_eapctl(line.runtime, "discover", "--from", "9.9.9.9.9.9")
    assert unknown.returncode == 1
    assert "no route to 9.9.9.9.9.9" in unknown.stderr


PAGE = (ROOT / "docs" / "discover.md").read_text()
BLOCK = re.compile(r"```console\n(.*?)```", re.DOTALL)


def outline(text: str) -> str:
    """Reduce an output to what is the same in every run."""
    text = re.sub(r"\d+(\.\d+)? (µs|ms)\b", "TIME", text)
    text = re.sub(r"\b\d+(\.\d+)? to \d+(\.\d+)?", "RANGE", text)
    text = re.sub(
        r'"(rate_hz|jitter_us|jitter_max_us|received|age_ms|missed)":[\d.]+', r'"\1":N', text
    )
    text = re.sub(r"[\d.]+ +TIME", "HZ TIME", text)
    # The guesses depend on the moment; tests/unit/eap/pd/test_appearance.py has their tests.
    text = re.sub(r" *# looks like .*\n", "", text)
    text = re.sub(r'"looks_like":.*', '"looks_like":[]}', text)
    text = re.sub(r"─+", "─", text)
    return "\n".join(" ".join(row.split()) for row in text.splitlines())


def test_examples_of_the_page_print_what_it_shows(line: Appliance, line_network: Namespace) -> None:
    with (
        shell(COLUMNS="100", EAP_RUNTIME_DIR=str(line.runtime)) as reader,
        inside(line_network),
    ):
        shown = list(replayed(reader))
    command, ready, _ = shown[0]
    assert command == "eapctl run config/solar-line.yaml &"
    assert json.loads(ready)["stations"] == [each["name"] for each in line.status()["stations"]]
    assert len(shown) >= 7
    for command, expected, printed in shown[1:]:
        assert outline(printed) == outline(expected), command


def replayed(reader: Shell) -> Iterator[tuple[str, str, str]]:
    for block in BLOCK.findall(PAGE):
        for command, expected in commands(block):
            # The first starts the line, which runs already.
            yield command, expected, "" if command.endswith(" &") else reader.run(command)


def send_again(network: Namespace, path: Path) -> dict[str, int]:
    """Send the captured frames to their destinations at their own pace, from another host."""
    sent: dict[str, int] = {}
    with network.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        start_s = first_s = None
        for frame in iter_capture(path):
            if frame.data[1] >> 4 != FrameType.PROCESS_DATA:
                continue  # probes of routes
            at_s = frame.at_ns / 1e9
            if start_s is None or first_s is None:
                start_s, first_s = time.monotonic(), at_s
            time.sleep(max(0.0, start_s + at_s - first_s - time.monotonic()))
            host, _, port = frame.packet.destination.partition(":")
            sock.sendto(frame.data, (host, int(port)))
            sent[host] = sent.get(host, 0) + 1
    return sent


def pd_list(appliance: Appliance) -> list[dict[str, Any]]:
    rows = map(json.loads, appliance.command("pd", "list", "--json").splitlines())
    return [row for row in rows if row["direction"] == "rx"]


def test_written_plant_receives_all_pds_and_loses_none(
    capture: Path, farm: Plants, shared: SharedAppliance
) -> None:
    """In a network of its own, where it has the addresses of the line's stations."""
    shared.stop()  # it costs a quarter of a processor
    target = farm.folder / "found.yaml"
    rows = discover(farm.folder, "--pcap", capture, "--write", target)
    # A busy host leaves cycles out: then the capture has gaps already, which are no loss here.
    gaps = {(row["publisher"], row["pd_id"]): row["missed"] for row in rows}
    with namespace() as other:
        appliance = farm.run(target, prefix=other.prefix)
        sent = sum(send_again(other, capture).values())
        assert sent > CAPTURED * 0.9

        def received() -> int:
            return sum(rx["received"] for rx in appliance.status()["stations"][0]["pd"]["rx"])

        wait_until(lambda: received() >= sent)
        station = appliance.status()["stations"][0]
        assert len(station["pd"]["rx"]) == 54
        for rx, row in zip(station["pd"]["rx"], pd_list(appliance), strict=True):
            assert troubles(rx) == (gaps[row["publisher"], row["id"]], 0, 0)
        assert received() == sent
        assert station["discarded"] == {}
        assert {rx["state"] for rx in station["pd"]["rx"]} == {"running"}
        appliance.stop()


@pytest.fixture(scope="module")
def pair(module_farm: Plants) -> Iterator[Namespace]:
    """Two stations on one cable; the network of the left one."""
    plant = ROOT / "config/ethernet-pair.yaml"
    with cable() as ends:
        for name, end in zip(("left", "right"), ends, strict=True):
            module_farm.run(plant, "--station", name, prefix=end.prefix)
        yield ends[0]


@pytest.mark.host_root
def test_discover_needs_one_capability_and_sees_both_directions(
    pair: Namespace, tmp_path: Path
) -> None:
    user = ["setpriv", "--reuid=64951", "--regid=64951", "--clear-groups"]
    # dac_read_search: this tree may belong to another user.
    capabilities = "+net_raw,+dac_read_search"
    user += [f"--inh-caps={capabilities}", f"--ambient-caps={capabilities}"]
    plant = str(ROOT / "config/ethernet-pair.yaml")
    command = [*pair.prefix, *user, *EAPCTL, "discover", "line0", "--for", "0.5", "--json"]
    done = subprocess.run(
        [*command, "--plant", plant],
        env=os.environ | {"EAP_RUNTIME_DIR": str(tmp_path / "none")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    rows = [json.loads(row) for row in done.stdout.splitlines()]
    assert [(row["publisher"], row["destination"]) for row in rows] == [
        ("10.88.164.1.2.1", "01:01:05:04:00:00"),
        ("10.88.164.2.2.1", "01:01:05:04:00:00"),
    ]
    assert [row["taken_by"] for row in rows] == ["right/peer", "left/peer"]
    assert rows[0]["sources"] == [pair.mac()]
    assert {row["step"] for row in rows} == {1}


LENIENT = """
plant: lenient
stations:
  - name: panel
    net_id: 10.0.9.9.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://127.0.1.1", net_id: 10.0.9.9.2.1, length: lenient}
    subscribe:
      - {name: tool, port: eap0, from: {publisher: 5.5.5.5.1.1, id: 7}, foreign: true,
         variables: {level: UINT}}
"""


def test_lenient_port_takes_frames_of_a_tool_with_wrong_length(farm: Plants) -> None:
    with namespace() as network:
        appliance = farm.run(farm.write(LENIENT), prefix=network.prefix)
        with network.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            for cycle in range(3):
                header = PdFrameHeader(NetId.parse("5.5.5.5.1.1"), 1, cycle)
                right = encode_frame(header, [(PdHeader(7, 0, 2), b"\x34\x12")])
                sock.sendto(EtherCatHeader(4).encode() + right[2:], ("127.0.1.1", 34980))
        wait_until(lambda: appliance.rx("panel", "tool")["received"] == 3)
        assert appliance.rx("panel", "tool")["discarded"] == {"wrong_length": 3}
        assert appliance.status()["stations"][0]["discarded"] == {"wrong_length": 3}
        assert appliance.values("panel")["level"] == 0x1234
        appliance.stop()
