"""Plant files made by ``eapctl new``: they pass the checks, whatever was asked for."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.config.load import Plant, load
from eap.config.new_plant import MAX_STATIONS, Shape, plant_text
from eap.errors import ConfigError


def loaded(tmp_path: Path, text: str) -> Plant:
    path = tmp_path / "plant.yaml"
    path.write_text(text)
    result = load(path, lambda _: pytest.fail("there is no bus"))
    assert result.findings == ()
    assert result.plant is not None
    return result.plant


def test_ring(tmp_path):
    plant = loaded(tmp_path, plant_text("line", 4, Shape.RING))
    assert plant.name == "line"
    assert [station.name for station in plant.stations] == [f"station-0{n}" for n in range(1, 5)]
    first, last = plant.stations[0], plant.stations[-1]
    assert (str(first.net_id), str(first.ports[0].net_id)) == ("127.0.1.1.1.1", "127.0.1.1.2.1")
    assert str(last.ports[0].interface) == "udp://127.0.1.4"
    assert last.frames[0].destination == "127.0.1.1"
    assert first.subscriptions[0].publisher == str(last.ports[0].net_id)
    assert first.subscriptions[0].pd_id == last.frames[0].pds[0].pd_id


def test_star(tmp_path):
    plant = loaded(tmp_path, plant_text("line", 4, Shape.STAR, cycle_us=500))
    hub, *others = plant.stations
    assert [frame.destination for frame in hub.frames] == [f"127.0.1.{n}" for n in (2, 3, 4)]
    assert [each.publisher for each in hub.subscriptions] == [
        str(s.ports[0].net_id) for s in others
    ]
    assert {frame.destination for s in others for frame in s.frames} == {"127.0.1.1"}
    assert {s.cycle_us for s in plant.stations} == {500}


def test_ids_are_unique(tmp_path):
    for shape in Shape:
        plant = loaded(tmp_path, plant_text("line", MAX_STATIONS, shape))
        sent = [pd.pd_id for s in plant.stations for frame in s.frames for pd in frame.pds]
        assert len(set(sent)) == len(sent) == (250 if shape is Shape.RING else 2 * 249)


@pytest.mark.parametrize(
    ("address", "second"),
    [
        ("10.1.{n}.1", "udp://10.1.2.1"),
        ("10.1.0.255", "udp://10.1.1.0"),
        ("udp://10.1.0.{n}:34990", "udp://10.1.0.2:34990"),
        ("ethernet://eth{n}", "ethernet://eth2"),
        ("ethernet://eth0", "ethernet://eth0"),
    ],
)
def test_addresses(tmp_path, address, second):
    for shape in Shape:
        plant = loaded(tmp_path, plant_text("line", 3, shape, address=address))
        assert str(plant.stations[1].ports[0].interface) == second


@pytest.mark.parametrize(
    ("name", "count", "address", "reason"),
    [
        ("line", 1, "127.0.1.{n}", "a ring has 2 to 250"),
        ("line", 251, "127.0.1.{n}", "a ring has 2 to 250"),
        ("my line", 3, "127.0.1.{n}", "plant name 'my line'"),
        ("line", 3, "127.0.1", "is not an IPv4 address"),
        ("line", 250, "127.0.7{n}.1", "is not an IPv4 address"),
        ("line", 3, "239.1.1.{n}", "no address of a station"),
        ("line", 3, "255.255.255.254", "no address of a station"),
        ("line", 3, "255.255.255.253", "no address of a station"),
        ("line", 3, "tcp://127.0.1.{n}", "udp and ethernet"),
        ("line", 3, 'ethernet://e"0', "no interface name"),
    ],
)
def test_invalid_plant_is_refused(name, count, address, reason):
    with pytest.raises(ConfigError, match=reason):
        plant_text(name, count, Shape.RING, address=address)


@pytest.mark.parametrize("name", ["true", "null", "12", "a:b", "#1", '"', "ofen-3", "für"])
def test_names_stay_as_they_are(tmp_path, name):
    assert loaded(tmp_path, plant_text(name, 2, Shape.RING)).name == name


@given(st.integers(2, 40), st.sampled_from(Shape))
def test_lines_are_short(count, shape):
    lines = plant_text("line", count, shape).splitlines()
    assert max(map(len, lines)) <= 120


def test_the_commands_name_the_file():
    assert "#   eapctl plan halls/line.yaml\n" in plant_text(
        "line", 2, Shape.RING, file="halls/line.yaml"
    )
