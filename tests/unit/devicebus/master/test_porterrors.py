from __future__ import annotations

from devicebus.master.master import Master
from devicebus.master.porterrors import Growth, PortErrorLog
from tests.support.busline import MS, Paced, segment, slave


def counters(**at):
    octets = bytearray(0x14)
    for name, count in at.items():
        octets[{"crc0": 0, "rx1": 3, "forwarded2": 10, "lost3": 19}[name]] = count
    return bytes(octets)


def test_port_error_log_first_look_says_nothing_about_times():
    log = PortErrorLog()
    log.take(1001, counters(crc0=7), 5)
    assert log.of(1001) == {}


def test_port_error_log_notes_first_and_last_growth_of_each_port():
    log = PortErrorLog()
    for now_ns, octets in (
        (5, counters()),
        (6, counters(crc0=1)),
        (7, counters(crc0=1, lost3=1)),
        (8, counters(crc0=3, lost3=1, forwarded2=9)),
        (9, counters(crc0=3, lost3=1, forwarded2=9)),
    ):
        log.take(1001, octets, now_ns)
    assert log.of(1001) == {0: Growth(6, 8), 3: Growth(7, 7)}


def test_port_error_log_counters_that_were_cleared_end_older_times():
    log = PortErrorLog()
    for now_ns, octets in ((5, counters()), (6, counters(crc0=1)), (7, counters())):
        log.take(1001, octets, now_ns)
    assert log.of(1001) == {}
    log.take(1001, counters(rx1=2), 8)
    assert log.of(1001) == {1: Growth(8, 8)}


def test_port_error_log_forgets():
    log = PortErrorLog()
    for now_ns in (5, 6):
        log.take(1001, counters(crc0=now_ns), now_ns)
    log.clear()
    assert log.of(1001) == {}
    log.take(1001, counters(crc0=6), 7)
    assert log.of(1001) == {}


def test_master_reads_error_counters_once_a_second_while_cycles_run():
    line = Paced(Master(), segment(slave("a"), slave("b")))
    line.wait(line.core.bring_up(line.now_ns))
    line.elapse(1_100 * MS)
    line.segment.slaves[1].esc.memory[0x0300] = 4
    begun_ns = line.now_ns
    line.elapse(1_100 * MS)
    (seen,) = line.core.port_errors.of(1002).values()
    assert seen.since_ns == seen.until_ns
    assert 0 < seen.until_ns - begun_ns < 1_010 * MS
    assert line.core.port_errors.of(1001) == {}
