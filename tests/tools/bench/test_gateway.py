"""Figures of a gateway's reads, clients and files."""

from __future__ import annotations

from pathlib import Path

from eap.codec.mailbox import MailboxType, decode_frame
from eap.config.load import load
from eap.runtime.busfile import describe
from tools.bench.figures import Decision
from tools.bench.gateway import (
    Round,
    crowd_figure,
    file_figures,
    late_figures,
    plant,
    read_figures,
)
from tools.bench.gateway_roles import request


def test_reads_are_compared_with_the_echo_and_with_cycles() -> None:
    master, slave = read_figures([Round(20_000, 9_000, 100, 3_100)] * 3)
    assert (master.value, master.decision) == (0.45, Decision.MISSED)
    assert master.measured == "0.45 (9.0 to 20.0 thousand/s)"
    assert (slave.value, slave.decision) == (1.5, Decision.OK)


def test_slowest_client_is_compared_with_the_quickest() -> None:
    assert crowd_figure([50, 70, 100], 2.0).decision is Decision.OK
    assert crowd_figure([49, 70, 100], 2.0).decision is Decision.MISSED
    assert crowd_figure([0, 0], 2.0).value == 0


def test_files_are_reported() -> None:
    stored, fetched = file_figures("UDP", [{"stored": 0.5, "fetched": 1.0}] * 2)
    assert (stored.measured, fetched.measured) == ("2.00 MB/s", "1.00 MB/s")


def test_lateness_is_compared_with_that_beside_an_echo() -> None:
    nobody, echo, gateway = ({"p50": us, "p99": 9 * us, "max": 20 * us} for us in (5, 10, 13))
    p50, p99, longest = late_figures(nobody, echo, gateway)
    assert p50.measured == "1.30 (13, 10 µs; 5 µs without clients)"
    assert (p50.decision, p99.decision) == (Decision.OK, Decision.OK)
    assert longest.measured == "260, 200 and 100 µs"
    assert late_figures(nobody, nobody, gateway)[0].decision is Decision.MISSED


def test_plant_and_request_are_what_they_should_be(tmp_path: Path) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text(plant())
    result = load(path, describe)
    assert result.plant is not None, result.findings
    header, body = decode_frame(request(1001))
    assert (header.address, header.type, bytes(body[:3])) == (1001, MailboxType.COE, b"\0\x20\x40")
