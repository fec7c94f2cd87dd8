"""Figures of ADS reads, hops and many clients."""

from __future__ import annotations

from pathlib import Path

from eap.config.load import load
from eap.runtime.plantfile import load_plant
from tools.bench import buses
from tools.bench.ads import (
    HOPS,
    SLAVES,
    SlaveReads,
    Trips,
    crowd_figure,
    hop_figures,
    plant,
    reads_figure,
    slave_figures,
    slave_plant,
)
from tools.bench.figures import Decision


def test_reads_are_compared_by_round() -> None:
    figure = reads_figure([(12_000.0, 10_000.0), (4000.0, 4000.0), (12_000.0, 10_000.0)])
    assert (figure.value, figure.decision) == (1.2, Decision.OK)
    assert figure.measured == "1.20 (12.0 to 10.0 thousand/s)"


def test_hop_is_what_it_adds() -> None:
    raw, looped = hop_figures("mail", 2.4, [Trips(200_000.0, 100_000.0, 40_000.0, 50_000.0)] * 3)
    assert (raw.value, raw.decision) == (2.5, Decision.MISSED)
    assert raw.measured == "2.50 (100 to 200 µs, an echo 40 µs)"
    assert (looped.value, looped.measured) == (2.0, "2.00 (50 µs)")


def test_slowest_client_is_compared_with_the_median() -> None:
    figure = crowd_figure([50, 100, 101], 2.0)
    assert (figure.value, figure.decision) == (0.5, Decision.OK)
    assert crowd_figure([0, 100, 101], 2.0).decision is Decision.MISSED
    assert crowd_figure([0, 0, 0], 2.0).decision is Decision.MISSED


def test_slave_reads_by_ads_are_compared_with_the_gateway() -> None:
    at_once, alone = slave_figures([SlaveReads(600.0, 1000.0, 1500.0, 1000.0)] * 3)
    assert (at_once.value, at_once.decision) == (0.6, Decision.MISSED)
    assert at_once.measured == "0.60 (600 to 1000 reads/s)"
    assert (alone.value, alone.decision) == (1.5, Decision.MISSED)
    assert alone.measured == "1.50 (1500 to 1000 µs)"


def test_slave_plant_has_the_slaves_that_are_read(tmp_path: Path) -> None:
    (tmp_path / "bus.yaml").write_bytes(buses.encode(buses.bus(len(SLAVES), 512)))
    (tmp_path / "plant.yaml").write_text(slave_plant())
    result = load_plant(tmp_path / "plant.yaml")
    assert result.plant is not None, result.findings
    bus = result.plant.stations[0].ports[1].bus
    assert bus is not None
    assert [slave.station for slave in bus.slaves] == SLAVES


def test_plants_can_be_loaded(tmp_path: Path) -> None:
    path, found = tmp_path / "plant.yaml", []
    for route, _ in HOPS.values():
        path.write_text(plant(route))
        result = load(path, lambda *_: (None, ()))
        assert result.plant is not None, result.findings
        hops = [each.hop for each in result.plant.routing["near"].routes]
        found.append(*hops)
    assert [str(each.kind) for each in found] == ["udp", "ams-tcp"]
