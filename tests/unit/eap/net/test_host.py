from __future__ import annotations

import pytest

from eap.errors import EnvironmentalError
from eap.net.host import Host
from eap.pd.spec import INTERFACE_MEASURES, Measure

STAT = "cpu  {user} 10 20 {idle} 50 1 2 3 4 5\ncpu0 1 2 3 4 5 6 7 8 0 0\nctxt 987654\n"
DEV = """Inter-|   Receive                        |  Transmit
 face |bytes    packets errs drop fifo frame compressed multicast|bytes    packets errs
    lo: 1111 22 0 0 0 0 0 0 3333 44 0 0 0 0 0 0
  eth0:5555 66 0 0 0 0 0 0 7777 88 0 0 0 0 0 0
"""


@pytest.fixture
def root(tmp_path):
    proc = tmp_path / "proc"
    (proc / "net").mkdir(parents=True)
    (proc / "loadavg").write_text("0.52 1.04 2.08 3/765 4711\n")
    (proc / "uptime").write_text("12345.67 23456.78\n")
    (proc / "meminfo").write_text(
        "MemTotal:        8000 kB\nMemFree: 100 kB\nMemAvailable: 6000 kB\n"
    )
    (proc / "stat").write_text(STAT.format(user=100, idle=814))
    (proc / "net/dev").write_text(DEV)
    for zone, milli in (("thermal_zone0", 41500), ("thermal_zone1", 52000)):
        folder = tmp_path / "sys/class/thermal" / zone
        folder.mkdir(parents=True)
        (folder / "temp").write_text(f"{milli}\n")
    return tmp_path


@pytest.mark.parametrize(
    ("measure", "argument", "value"),
    [
        ("load1", "", 0.52),
        ("load5", "", 1.04),
        ("load15", "", 2.08),
        ("cpu_time", "", 1.36),
        ("cpu_percent", "", 13.6),
        ("memory_total", "", 8000),
        ("memory_available", "", 6000),
        ("memory_used", "", 2000),
        ("memory_percent", "", 25.0),
        ("rx_octets", "lo", 1111),
        ("tx_octets", "eth0", 7777),
        ("rx_packets", "eth0", 66),
        ("tx_packets", "lo", 44),
        ("uptime", "", 12345.67),
        ("processes", "", 765),
        ("context_switches", "", 987654),
        ("temperature", "", 41.5),
        ("temperature", "thermal_zone1", 52.0),
    ],
)
def test_reads_what_the_kernel_says(root, measure, argument, value):
    assert Host(root).read(Measure(measure), argument) == pytest.approx(value)


@pytest.mark.parametrize("measure", Measure)
def test_every_measure_can_be_read(root, measure):
    argument = "lo" if measure in INTERFACE_MEASURES else ""
    assert Host(root).read(measure, argument) > 0


def test_cpu_percent_is_the_share_since_the_reading_before(root):
    host = Host(root)
    host.read(Measure.CPU_PERCENT)
    (root / "proc/stat").write_text(STAT.format(user=130, idle=884))
    assert host.read(Measure.CPU_PERCENT) == pytest.approx(30.0)
    assert host.read(Measure.CPU_PERCENT) == pytest.approx(30.0)  # no tick has passed


@pytest.mark.parametrize(
    ("measure", "argument", "words"),
    [
        (Measure.RX_OCTETS, "eth7", "no interface 'eth7'"),
        (Measure.TEMPERATURE, "thermal_zone9", "thermal_zone9"),
    ],
)
def test_what_a_host_lacks_is_named(root, measure, argument, words):
    with pytest.raises(EnvironmentalError, match=words):
        Host(root).read(measure, argument)


def test_a_host_without_zones_or_proc_says_so(tmp_path):
    with pytest.raises(EnvironmentalError, match="no temperature"):
        Host(tmp_path).read(Measure.TEMPERATURE)
    with pytest.raises(EnvironmentalError, match="No such file"):
        Host(tmp_path).read(Measure.LOAD1)


@pytest.mark.parametrize(
    ("file", "measure"), [("meminfo", "memory_used"), ("stat", "cpu_time"), ("uptime", "uptime")]
)
def test_an_odd_proc_is_no_traceback(root, file, measure):
    (root / "proc" / file).write_text("cpu x\n")
    with pytest.raises(EnvironmentalError, match=measure):
        Host(root).read(Measure(measure))


def test_this_host_can_be_measured():
    host = Host()
    assert host.read(Measure.MEMORY_TOTAL) > host.read(Measure.MEMORY_AVAILABLE) > 0
    assert 0 <= host.read(Measure.CPU_PERCENT) <= 100
    assert host.read(Measure.RX_OCTETS, "lo") >= 0
