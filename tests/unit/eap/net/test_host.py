from __future__ import annotations

import os

import pytest

from eap.errors import EnvironmentalError
from eap.net.host import Host, open_replay, read_password, read_password_text
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
def test_host_error_names_missing_source(root, measure, argument, words):
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


MS = 1_000_000


def test_rows_follow_each_other_and_begin_again(tmp_path):
    path = tmp_path / "oven.csv"
    path.write_text("time,temperature\n0,180.5\n1,181\n2,179.25\n")
    replay = open_replay(path, "temperature", period_ms=100)
    times = (0, 99, 100, 250, 300, 650)
    assert [replay.value(at * MS) for at in times] == [
        "180.5",
        "180.5",
        "181",
        "179.25",
        "180.5",
        "180.5",
    ]


def test_a_short_row_has_an_empty_value(tmp_path):
    path = tmp_path / "short.csv"
    path.write_text("a,b\n1\n")
    assert open_replay(path, "b", period_ms=1).value(0) == ""


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "No such file"),
        (b"a,b\n1,2\n", "no column 'c'"),
        (b"", "no column 'c'"),
        (b"c\n", "no rows"),
        (b"c\n\xff\n", "UTF-8"),
        (b'c\n"1\n', "no CSV file"),
    ],
)
def test_a_file_that_cannot_be_replayed_is_named(tmp_path, content, words):
    path = tmp_path / "bad.csv"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(EnvironmentalError, match=words) as caught:
        open_replay(path, "c", period_ms=1)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("content", ["secret", "secret\n", "secret\r\nmore\n"])
def test_the_first_line_is_the_password(tmp_path, content):
    file = tmp_path / "pw"
    file.write_bytes(content.encode())
    assert read_password(file) == b"secret"
    assert read_password_text(file) == "secret"


def test_octets_that_are_no_text(tmp_path):
    file = tmp_path / "pw"
    file.write_bytes(b"\xff\n")
    assert read_password(file) == b"\xff"
    with pytest.raises(EnvironmentalError, match="pw: its first line is not UTF-8"):
        read_password_text(file)


def test_password_file_must_be_regular(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for name in ("pipe", "."):
        with pytest.raises(EnvironmentalError, match=r"kept in a regular file|Is a directory"):
            read_password(tmp_path / name)
    with pytest.raises(EnvironmentalError, match="gone: No such file"):
        read_password(tmp_path / "gone")
