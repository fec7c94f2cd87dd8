"""What is said of a gateway's reads, clients and files."""

from __future__ import annotations

from pathlib import Path

from eap.appliance.busfile import describe
from eap.codec.mailbox import MailboxType, decode_frame
from eap.config.load import load
from tools.bench.figures import Verdict
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
    assert (master.value, master.verdict) == (0.45, Verdict.MISSED)
    assert master.measured == "0.45 (9.0 to 20.0 thousand/s)"
    assert (slave.value, slave.verdict) == (1.5, Verdict.OK)


def test_slowest_client_is_compared_with_the_quickest() -> None:
    assert crowd_figure([50, 70, 100], 2.0).verdict is Verdict.OK
    assert crowd_figure([49, 70, 100], 2.0).verdict is Verdict.MISSED
    assert crowd_figure([0, 0], 2.0).value == 0


def test_files_and_lateness_are_reported() -> None:
    stored, fetched = file_figures("UDP", [{"stored": 0.5, "fetched": 1.0}] * 2)
    assert (stored.measured, fetched.measured) == ("2.00 MB/s", "1.00 MB/s")
    late = late_figures({"p50": 5, "p99": 9, "max": 90}, {"p50": 6, "p99": 8, "max": 70})
    assert [each.measured for each in late] == ["6 and 5 µs", "8 and 9 µs", "70 and 90 µs"]


def test_plant_and_request_are_what_they_should_be(tmp_path: Path) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text(plant())
    result = load(path, describe)
    assert result.plant is not None, result.findings
    header, body = decode_frame(request(1001))
    assert (header.address, header.type, bytes(body[:3])) == (1001, MailboxType.COE, b"\0\x20\x40")
