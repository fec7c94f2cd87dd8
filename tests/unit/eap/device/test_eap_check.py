from __future__ import annotations

import pytest
from msgspec.structs import replace

from eap.device.eap_records import read_back
from eap.od.profiles.eap1000 import AddressMode, FrameEntry, Rx, RxFlag, Tx, Var
from eap.pd.device import DeviceFault, FaultCode
from eap.pd.spec import CounterSource, HostSource, LinkSpec, Measure, VariableSpec, Writer
from tests.support.downloads import frame, mapping, receiver, rx_pd, sender, tx_pd, variable, write
from tests.support.stations import BLANK, empty, filled


@pytest.fixture
def ports():
    """Two PDs in two frames and two that are received, on one port; nothing on the other."""
    ports = empty()
    udp = ports["eap0"]
    receiver(sender(udp))
    mapping(udp, 0x1A01, (variable(udp, 0x6001, "second"), 16))
    frame(udp, 0x8001, tx_pd(udp, 0xD001, 0x1A01, 2))
    mapping(udp, 0x1601, (variable(udp, 0x7001, "other"), 16))
    rx_pd(udp, 0xE001, 0x1601, 2)
    return ports


@pytest.mark.parametrize(
    ("writes", "fault"),
    [
        ([(0x8001, FrameEntry.NAME, "frame0")], (FaultCode.NAME_TWICE, 0x8001, FrameEntry.NAME)),
        ([(0xD001, Tx.NAME, "txpd0")], (FaultCode.NAME_TWICE, 0xD001, Tx.NAME)),
        ([(0xE001, Rx.NAME, "rxpd0")], (FaultCode.NAME_TWICE, 0xE001, Rx.NAME)),
        ([(0xD001, Tx.PD_ID, 1)], (FaultCode.PD_ID_TWICE, 0xD001, Tx.PD_ID)),
        ([(0x8000, FrameEntry.MODULO, 1)], (FaultCode.MODULO, 0x8000, FrameEntry.MODULO)),
        ([(0xD000, Tx.MODULO, 1)], (FaultCode.MODULO, 0xD000, Tx.MODULO)),
        ([(0xD000, Tx.CYCLE_TIME, 1500)], (FaultCode.CYCLE_TIME, 0xD000, Tx.CYCLE_TIME)),
        (
            [(0xD000, Tx.CYCLE_TIME, 1000), (0xD000, Tx.DIVIDER, 2)],
            (FaultCode.TRIGGERS, 0xD000, Tx.DIVIDER),
        ),
        (
            [(0xD000, Tx.ON_CHANGE, 1), (0xD000, Tx.CYCLE_TIME, 1000)],
            (FaultCode.TRIGGERS, 0xD000, Tx.ON_CHANGE),
        ),
        (
            [(0xD000, Tx.ON_CHANGE_TIMEOUT, 1), (0xD000, Tx.ON_CHANGE_INHIBIT, 1001)],
            (FaultCode.TIME_OUT, 0xD000, Tx.ON_CHANGE_TIMEOUT),
        ),
        (
            [(0x8000, FrameEntry.DIVIDER, 4), (0xD000, Tx.DIVIDER, 6)],
            (FaultCode.GATE, 0xD000, Tx.DIVIDER),
        ),
        (
            [(0x8000, FrameEntry.DIVIDER, 4), (0xD000, Tx.CYCLE_TIME, 20000)],
            (FaultCode.GATE, 0xD000, Tx.CYCLE_TIME),
        ),
        (
            [
                (0x8000, FrameEntry.DIVIDER, 2),
                (0x8000, FrameEntry.MODULO, 1),
                (0xD000, Tx.DIVIDER, 4),
            ],
            (FaultCode.GATE, 0xD000, Tx.DIVIDER),
        ),
        (
            [(0x8000, FrameEntry.MONITOR_IP, b"\x0a\0\0\2")],
            (FaultCode.MONITORING, 0x8000, FrameEntry.MONITOR_IP),
        ),
        (
            [(0x8000, FrameEntry.MONITORING_INTERVAL, 99)],
            (FaultCode.MONITORING, 0x8000, FrameEntry.MONITORING_INTERVAL),
        ),
        (
            [(0x8000, FrameEntry.MONITORING_INTERVAL, 100), (0x8000, FrameEntry.ADDRESS_MODE, 3)],
            (FaultCode.MONITORING, 0x8000, FrameEntry.MONITORING_INTERVAL),
        ),
        (
            [
                (0x8000, FrameEntry.MONITORING_INTERVAL, 100),
                (0x8000, FrameEntry.DESTINATION_IP, b"\xef\1\1\1"),
            ],
            (FaultCode.MONITORING, 0x8000, FrameEntry.MONITORING_INTERVAL),
        ),
        ([(0xE001, Rx.PD_ID, 1)], (FaultCode.RECEIVED_TWICE, 0xE001, Rx.PD_ID)),
        ([(0xE001, Rx.PDO_INDEX, 0x1600)], (FaultCode.RECEIVED_TWICE, 0xE001, Rx.PDO_INDEX)),
        (
            [(0xE000, Rx.TIME_OUT, 9)],
            (FaultCode.TIME_OUT, 0xE000, Rx.TIME_OUT),
        ),
        (
            [(0xD000, Tx.POLL_REQUEST_RXPD, 0xE000)],
            (FaultCode.POLL, 0x8000, FrameEntry.ADDRESS_MODE),
        ),
        (
            [(0x8000, FrameEntry.ADDRESS_MODE, AddressMode.REQUESTER)],
            (FaultCode.POLL, 0x8000, FrameEntry.ADDRESS_MODE),
        ),
        (
            [
                (0x8000, FrameEntry.ADDRESS_MODE, AddressMode.REQUESTER),
                (0x8000, FrameEntry.DIVIDER, 2),
                (0xD000, Tx.POLL_REQUEST_RXPD, 0xE000),
            ],
            (FaultCode.TRIGGERS, 0x8000, FrameEntry.DIVIDER),
        ),
        (
            [
                (0x8000, FrameEntry.ADDRESS_MODE, AddressMode.REQUESTER),
                (0xD000, Tx.POLL_REQUEST_RXPD, 0xE000),
                (0xD000, Tx.EVENT, 1),
            ],
            (FaultCode.TRIGGERS, 0xD000, Tx.POLL_REQUEST_RXPD),
        ),
        (
            [
                (0x8000, FrameEntry.ADDRESS_MODE, AddressMode.REQUESTER),
                (0xD000, Tx.POLL_REQUEST_RXPD, 0xE000),
                (0xE000, Rx.FLAGS, 0),
            ],
            (FaultCode.POLL, 0xD000, Tx.POLL_REQUEST_RXPD),
        ),
        (
            [
                (0x8000, FrameEntry.ADDRESS_MODE, AddressMode.REQUESTER),
                (0xD000, Tx.POLL_REQUEST_RXPD, 0xE000),
                (0xE000, Rx.POLL_REQUEST_TXPD, 0xD001),
            ],
            (FaultCode.POLL, 0xD000, Tx.POLL_REQUEST_RXPD),
        ),
        (
            [
                (0x8000, FrameEntry.ADDRESS_MODE, AddressMode.REQUESTER),
                (0xD000, Tx.POLL_REQUEST_RXPD, 0xE000),
                (0xE001, Rx.POLL_REQUEST_TXPD, 0xD000),
            ],
            (FaultCode.POLL, 0xE001, Rx.POLL_REQUEST_TXPD),
        ),
        (
            [(0xE001, Rx.POLL_REQUEST_TXPD, 0xD000), (0xE001, Rx.STEP, 1)],
            (FaultCode.POLL, 0xE001, Rx.STEP),
        ),
    ],
)
def test_each_fault_names_its_object(ports, writes, fault):
    for where in writes:
        write(ports["eap0"], *where)
    with pytest.raises(DeviceFault) as caught:
        read_back(BLANK, ports)
    assert (caught.value.code, caught.value.index, caught.value.subindex) == fault
    assert caught.value.port == "eap0"


def test_names_are_given_once_in_the_station(ports):
    other = ports["eap1"]
    mapping(other, 0x1A00, (variable(other, 0x6000, "third"), 16))
    frame(other, 0x8000, tx_pd(other, 0xD000, 0x1A00, 1), to=b"\x02\0\0\0\0\1")
    with pytest.raises(DeviceFault, match="frame frame0 is 0x8000 of eap0 already") as caught:
        read_back(BLANK, ports)
    assert caught.value.port == "eap1"
    write(other, 0x8000, FrameEntry.NAME, "other")
    write(other, 0xD000, Tx.NAME, "other")
    assert len(read_back(BLANK, ports).frames) == 3  # IDs are unique per publisher


def test_polls_that_fit_are_taken(ports):
    udp = ports["eap0"]
    write(udp, 0x8000, FrameEntry.ADDRESS_MODE, AddressMode.REQUESTER)
    write(udp, 0xD000, Tx.POLL_REQUEST_RXPD, 0xE000)
    write(udp, 0xE001, Rx.POLL_REQUEST_TXPD, 0xD001)
    spec = read_back(BLANK, ports)
    assert spec.frames[0].pds[0].poll_request == "rxpd0"
    assert spec.subscriptions[1].poll_request == "txpd1"


def test_old_and_new_version_of_a_pd_are_taken_side_by_side(ports):
    udp = ports["eap0"]
    write(udp, 0xE001, Rx.PD_ID, 1)
    write(udp, 0xE001, Rx.VERSION, 1)
    assert len(read_back(BLANK, ports).subscriptions) == 2
    write(udp, 0xE000, Rx.FLAGS, RxFlag.ENABLED | RxFlag.IGNORE_VERSION)
    with pytest.raises(DeviceFault) as caught:
        read_back(BLANK, ports)
    assert caught.value.code == FaultCode.RECEIVED_TWICE


class TestWhatTheStationNeeds:
    STATION = replace(
        BLANK,
        variables=(
            VariableSpec("counter", "UDINT", Writer.ENGINE),
            VariableSpec("load", "REAL", Writer.SERVICES),
            VariableSpec("from", "UINT"),
            VariableSpec("to", "UINT", Writer.ENGINE),
        ),
        sources=(CounterSource("counter"), HostSource("load", Measure.LOAD1)),
        links=(LinkSpec("from", "to"),),
    )

    @pytest.mark.parametrize(
        ("index", "subindex", "value", "code"),
        [
            (0x6000, 0, 0, FaultCode.IN_USE),
            (0x6002, Var.NAME, "gone", FaultCode.IN_USE),
            (0x6003, Var.TYPE_NAME, "INT", FaultCode.IN_USE),
            (0x6000, Var.WRITER, 0, FaultCode.WRITER),
            (0x6001, Var.WRITER, 1, FaultCode.WRITER),
            (0x6003, Var.WRITER, 2, FaultCode.WRITER),
        ],
    )
    def test_sources_and_links_find_their_variables(self, index, subindex, value, code):
        ports = filled(self.STATION)
        assert read_back(self.STATION, ports) == self.STATION
        write(ports["eap0"], index, subindex, value)
        with pytest.raises(DeviceFault) as caught:
            read_back(self.STATION, ports)
        assert caught.value.code == code

    def test_what_is_filled_is_not_received_too(self):
        ports = filled(self.STATION)
        udp = ports["eap0"]
        write(udp, 0x6003, 0, 0)
        mapping(udp, 0x1600, (variable(udp, 0x7000, "to"), 16))
        rx_pd(udp, 0xE000, 0x1600, 1)
        with pytest.raises(DeviceFault) as caught:
            read_back(self.STATION, ports)
        assert caught.value.code == FaultCode.WRITER
