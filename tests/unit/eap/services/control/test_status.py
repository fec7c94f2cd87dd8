"""The answer to ``status``."""

from __future__ import annotations

import asyncio
import os
import resource
from pathlib import Path
from time import CLOCK_BOOTTIME, clock_gettime_ns

import msgspec
import pytest

from eap.ids import InterfaceUri, NetId
from eap.net.image_file import create_image
from eap.net.limits import ListenerStats
from eap.pd.layout import plan_layout
from eap.pd.spec import PortKind, PortSpec
from eap.pd.words import StationWord
from eap.runtime.engine_messages import BusReport
from eap.runtime.folder import ApplianceInfo, ProcessInfo
from eap.runtime.handover import PortName
from eap.services.control import status
from eap.services.control.status import (
    ProcessMeter,
    SharedAnswer,
    appliance_status,
    interface_fault,
    link_state,
    take_snapshot,
)
from tests.support.eventually import eventually
from tests.support.virtualtime import run_virtual
from tests.unit.eap.conftest import left


def now_ns() -> int:
    return clock_gettime_ns(CLOCK_BOOTTIME)


def test_a_process_is_measured_since_its_start_then_since_the_last_time():
    meter = ProcessMeter()
    start = now_ns()
    first = meter.measure(os.getpid(), start)
    assert first["rss"] > 1_000_000
    assert first["cpu"] > 0
    soon = meter.measure(os.getpid(), start + status.MIN_SAMPLE_NS - 1)
    assert soon["cpu"] == first["cpu"]
    later = meter.measure(os.getpid(), start + 3600 * 1_000_000_000)
    assert later["cpu"] < 1


def test_a_process_that_is_gone_has_no_share():
    assert ProcessMeter().measure(2**22 + 1, now_ns()) == status.NOTHING_MEASURED


def test_process_meter_counts_descriptors():
    with Path("/dev/null").open() as one, Path("/dev/null").open() as other:
        measured = ProcessMeter().measure(os.getpid(), now_ns())["descriptors"]
        assert measured["used"] > max(one.fileno(), other.fileno()) // 2
    assert measured["limit"] == resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    assert ProcessMeter().measure(os.getpid(), now_ns())["descriptors"]["used"] < measured["used"]


@pytest.mark.parametrize(
    ("interface", "link"),
    [
        ("loop://line", "up"),
        ("udp://127.0.3.4", "up"),
        ("tcp://127.0.3.4", "up"),
        ("ethernet://lo", "up"),
        ("ethernet://nosuch0", "down"),
        ("udp://192.0.2.1", "down"),
    ],
)
def test_link_of_the_interface_behind_a_port(interface, link):
    assert link_state(interface) == link


@pytest.mark.parametrize(
    ("interface", "fault"),
    [
        ("loop://line", ""),
        ("udp://127.0.3.4", ""),
        ("udp://0.0.0.0", ""),
        ("ethernet://lo", ""),
        ("ethernet://nosuch0", "interface nosuch0 is gone: it was deleted"),
        ("tcp://192.0.2.1", "address 192.0.2.1 is gone: no interface has it now"),
    ],
)
def test_interface_that_is_gone_is_named(interface, fault):
    assert interface_fault(interface) == fault


def test_the_document_has_the_shape_of_the_contract(files, monkeypatch):
    info = ApplianceInfo(
        "demo",
        "demo.yaml",
        ["left", "right"],
        "2026-01-01T00:00:00+00:00",
        os.getpid(),
        ProcessInfo(os.getpid(), 2, {"realtime": {"scheduler": "fifo 50"}, "compiled": True}),
        ProcessInfo(0, 1),
    )
    images = [file.image for file in files.values()]
    monkeypatch.setattr(status, "monotonic_ns", lambda: 9_000_000_000)
    images[1].words[StationWord.CYCLE_AT_NS] = 4_000_000_000
    discarded = ({"left": {"other_vlan": 1}}, {"left": {"mailbox": 3}})
    listeners = [ListenerStats("control", 1, 64, 2, 3, 4, 8_000_000_000)]
    document = appliance_status(info, images, discarded, ProcessMeter(), {}, listeners)
    assert (document["version"], document["plant"]) == (1, "demo")
    processes = document["processes"]
    assert set(processes) == {"supervisor", "engine", "services"}
    assert processes["supervisor"]["pid"] == os.getpid()
    assert processes["engine"]["restarts"] == 2
    assert processes["engine"]["realtime"] == {"scheduler": "fifo 50"}
    assert processes["engine"]["compiled"] is True
    group = {"cycle_us": 10_000, "phase_us": 0, "stations": ["right"], "last_us": 0}
    assert processes["engine"]["groups"] == [group]
    assert processes["services"] == {"pid": None, **status.NOTHING_MEASURED, "restarts": 1}
    assert document["listeners"] == [
        {
            "name": "control", "open": 1, "limit": 64, "refused": 2, "evicted": 3, "overdue": 4,
            "crowded_ago_us": 1_000_000,
        }
    ]  # fmt: skip
    left, right = document["stations"]
    assert (left["name"], left["state"], left["ports"][0]["link"]) == ("left", "INIT", "up")
    assert (left["cycle_age_us"], right["cycle_age_us"]) == (None, 5_000_000)
    assert left["discarded"] == {"other_vlan": 1, "mailbox": 3}
    assert right["discarded"] == {}
    assert left["pd"]["tx"][0]["name"] == "state"
    assert right["pd"]["rx"][0]["lost"] == 0


def test_snapshot_within_a_cycle_is_taken_after_it_while_others_go_on(files):
    image = files["left"].image
    image.words[StationWord.CYCLE] = 1

    async def scene():
        async with asyncio.TaskGroup() as group:
            taken = group.create_task(take_snapshot(image))
            await asyncio.sleep(0)
            assert not taken.done()
            image.words[StationWord.OVERRUNS] = 5
            image.words[StationWord.FUTEX] = 1
        return taken.result()

    assert run_virtual(scene()).words[StationWord.OVERRUNS] == 5


def test_snapshot_of_an_engine_that_hangs_within_a_cycle(files, monkeypatch):
    monkeypatch.setattr(status, "SNAPSHOT_PAUSES", 2)
    image = files["left"].image
    image.words[StationWord.CYCLE] = 1
    assert run_virtual(take_snapshot(image)).words[StationWord.CYCLE] == 1


def test_buses_and_segments(tmp_path):
    bus = PortSpec(
        "bus0", PortKind.BUS, InterfaceUri.parse("sim://x.yaml"), NetId.parse("1.2.3.4.6.1")
    )
    station = msgspec.structs.replace(left(), ports=(*left().ports, bus))
    info = ApplianceInfo("demo", "demo.yaml", ["left"], "now", os.getpid())
    info.segments = {"left/bus0": ProcessInfo(os.getpid(), 3, step="building the slaves")}
    report = BusReport(is_up=True, cycles=5, malformed=1, dropped=2)
    with create_image(tmp_path / "left.image", plan_layout(station)) as file:
        documents = [
            appliance_status(info, [file.image], (), ProcessMeter(), buses)
            for buses in ({PortName("left", "bus0"): report}, {})
        ]
    told, silent = (document["stations"][0]["ports"] for document in documents)
    engines = [document["processes"]["engine"] for document in documents]
    assert engines[0]["bus_requests"] == {"malformed": 1, "dropped": 2}
    assert "bus_requests" not in engines[1]
    assert "bus" not in told[0]
    assert (told[1]["link"], told[1]["bus"]["cycles"]) == ("up", 5)
    assert silent[1]["link"] == "down"
    assert "bus" not in silent[1]
    segment = documents[0]["processes"]["segments"]["left/bus0"]
    assert (segment["pid"], segment["restarts"]) == (os.getpid(), 3)
    assert segment["step"] == "building the slaves"
    assert "step" not in engines[0]


def test_shared_answer_is_made_once_for_concurrent_requests():
    made = []

    async def run():
        go_on = asyncio.Event()

        async def make():
            made.append(number := len(made))
            await go_on.wait()
            return {"number": number}

        shared = SharedAnswer(make)
        first = asyncio.ensure_future(shared.get())
        await eventually(lambda: made)
        others = [asyncio.ensure_future(shared.get()) for _ in range(3)]
        await asyncio.sleep(0)
        others.pop().cancel()
        go_on.set()
        answers = [await each for each in (first, *others)]
        return [each["number"] for each in answers]

    assert run_virtual(run()) == [0, 1, 1]
    assert made == [0, 1]
