"""Faults of single objects; what reads back without any is tested with ``eap_read``."""

from __future__ import annotations

import pytest
from hypothesis import given
from msgspec.structs import replace

from eap.device.eap_dictionary import EapDictionary
from eap.device.eap_spec import PortReader, read_back
from eap.ids import InterfaceUri, NetId
from eap.od.abort import SdoAbortError
from eap.od.profiles.eap1000 import (
    AddressMode,
    Configured,
    FrameSub,
    PortSub,
    Rx,
    RxFlag,
    Tx,
    Var,
)
from eap.pd.device import DeviceFault, FaultCode
from eap.pd.spec import (
    CounterSource,
    HostSource,
    LinkSpec,
    Measure,
    OnChangeSpec,
    PortKind,
    PortSpec,
    RxAlternateSpec,
    RxPdSpec,
    SentVariableSpec,
    StationSpec,
    TriggerSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Writer,
)
from tests.support.downloads import (
    frame,
    mapping,
    receiver,
    rx_pd,
    sender,
    tx_pd,
    variable,
    write,
)
from tests.support.examples import examples
from tests.support.stations import BLANK, empty, filled, stations


def _fault(dictionary: EapDictionary) -> tuple[FaultCode, int, int]:
    reader = PortReader(dictionary)
    with pytest.raises(DeviceFault) as caught:
        _ = reader.port(), list(reader.frames()), list(reader.subscriptions())
    assert caught.value.port == dictionary.port.name
    return caught.value.code, caught.value.index, caught.value.subindex


def _on(interface: str) -> EapDictionary:
    ports = (
        PortSpec("eap0", PortKind.EAP, InterfaceUri.parse(interface), NetId.parse("1.1.1.1.2.1")),
    )
    return sender(EapDictionary(replace(BLANK, ports=ports), "eap0"))


def _change(dictionary: EapDictionary, *writes: tuple[int, int, object]) -> EapDictionary:
    for where in writes:
        write(dictionary, *where)
    return dictionary


@pytest.mark.parametrize(
    ("writes", "fault"),
    [
        ([(0xD000, Tx.PDO_INDEX, 0)], (FaultCode.NO_PDO, 0xD000, Tx.PDO_INDEX)),
        ([(0xD000, Tx.PDO_INDEX, 0x1A09)], (FaultCode.MISSING_OBJECT, 0xD000, Tx.PDO_INDEX)),
        ([(0x1A00, 0, 0)], (FaultCode.EMPTY_PDO, 0x1A00, 0)),
        (
            [(0x8000, FrameSub.TXPD + 1, 0xD009)],
            (FaultCode.MISSING_OBJECT, 0x8000, FrameSub.TXPD + 1),
        ),
        (
            [(0x8000, FrameSub.TXPD + 1, 0xD000)],
            (FaultCode.PD_IN_TWO_FRAMES, 0x8000, FrameSub.TXPD + 1),
        ),
        ([(0x8001, FrameSub.TXPD, 0xD000)], (FaultCode.PD_IN_TWO_FRAMES, 0x8001, FrameSub.TXPD)),
        ([(0x8000, FrameSub.TXPD, 0)], (FaultCode.EMPTY_FRAME, 0x8000, FrameSub.TXPD)),
        ([(0xD000, Tx.ENABLED, 0)], (FaultCode.EMPTY_FRAME, 0x8000, FrameSub.TXPD)),
        (
            [(0x8000, FrameSub.TXPD, 0), (0x8000, FrameSub.ENABLED, 0)],
            (FaultCode.PD_WITHOUT_FRAME, 0xD000, 0),
        ),
        ([(0x8000, 5, bytes(4))], (FaultCode.NO_DESTINATION, 0x8000, 5)),
        ([(0x8000, 2, AddressMode.MAC)], (FaultCode.NO_DESTINATION, 0x8000, 2)),
        (
            [(0x8000, 2, AddressMode.TCP), (0x8000, 5, b"\xef\1\1\1")],
            (FaultCode.NO_DESTINATION, 0x8000, 5),
        ),
        (
            [(0xD000, Tx.POLL_REQUEST_RXPD, 0xE004)],
            (FaultCode.MISSING_OBJECT, 0xD000, Tx.POLL_REQUEST_RXPD),
        ),
        (
            [(0xE000, Rx.POLL_REQUEST_TXPD, 0xD004)],
            (FaultCode.MISSING_OBJECT, 0xE000, Rx.POLL_REQUEST_TXPD),
        ),
        ([(0xE000, Rx.PDO_INDEX, 0)], (FaultCode.NO_PDO, 0xE000, Rx.PDO_INDEX)),
        ([(0xF810, PortSub.VLAN_ID, 5)], (FaultCode.PORT, 0xF810, PortSub.VLAN_ID)),
        ([(0xF811, 1, "01:00:5e:00:00:01")], (FaultCode.PORT, 0xF811, 1)),
    ],
)
def test_each_fault_names_its_object(udp, writes, fault):
    receiver(sender(udp))
    assert _fault(_change(udp, *writes)) == fault


@pytest.mark.parametrize(
    ("interface", "mode", "is_way"),
    [
        (interface, mode, mode in modes)
        for interface, modes in {
            "udp://10.0.0.1": {AddressMode.IP, AddressMode.TCP, AddressMode.REQUESTER},
            "tcp://10.0.0.1": {AddressMode.TCP, AddressMode.REQUESTER},
            "ethernet://eth0": {AddressMode.MAC, AddressMode.NET_ID, AddressMode.REQUESTER},
            "loop://line": {AddressMode.MAC, AddressMode.REQUESTER},
        }.items()
        for mode in AddressMode
    ],
)
def test_a_port_addresses_as_its_interface_can(interface, mode, is_way):
    dictionary = _on(interface)
    write(dictionary, 0x8000, FrameSub.ADDRESS_MODE, mode)
    write(dictionary, 0x8000, FrameSub.DESTINATION_NETID, bytes(range(1, 7)))
    if is_way:
        (read,) = (found.record for found in PortReader(dictionary).frames())
        assert (
            read.destination
            == {
                AddressMode.IP: "10.0.0.2",
                AddressMode.TCP: "tcp://10.0.0.2",
                AddressMode.MAC: "01:01:05:04:00:00",
                AddressMode.NET_ID: "1.2.3.4.5.6",
                AddressMode.REQUESTER: "requester",
            }[mode]
        )
        assert (read.mac, read.monitor_interval_ms, read.monitor_ip) == ("", 0, "")
    else:
        assert _fault(dictionary) == (FaultCode.NO_DESTINATION, 0x8000, FrameSub.ADDRESS_MODE)


@pytest.mark.parametrize(
    ("interface", "subindex", "is_taken"),
    [
        ("udp://10.0.0.1", PortSub.TCP, True),
        ("ethernet://eth0", PortSub.TCP, False),
        ("udp://10.0.0.1", PortSub.BROADCAST, True),
        ("tcp://10.0.0.1", PortSub.BROADCAST, False),
        ("ethernet://eth0", PortSub.VLAN_ID, True),
        ("loop://line", PortSub.VLAN_ID, False),
        ("ethernet://eth0", PortSub.VLAN_PRIORITY, False),
    ],
)
def test_a_port_has_what_its_interface_can(interface, subindex, is_taken):
    dictionary = _change(_on(interface), (0xF810, subindex, 1))
    if is_taken:
        assert PortReader(dictionary).port() != dictionary.port
    else:
        assert _fault(dictionary) == (FaultCode.PORT, 0xF810, subindex)


def test_a_mapping_that_no_longer_holds_is_a_fault_of_the_mapping(udp):
    sender(udp)
    udp.remove(0x6000)
    assert _fault(udp) == (FaultCode.BAD_MAPPING, 0x1A00, 0)


def test_a_frame_that_is_too_long_is_a_fault_of_the_frame(udp):
    for number in range(2):
        variable(udp, 0x6000 + number, f"block{number}", "BLOCK(800)")
        mapping(udp, 0x1A00 + number, (0x6000 + number, 255))
        tx_pd(udp, 0xD000 + number, 0x1A00 + number, number)
    frame(udp, 0x8000, 0xD000)
    second = FrameSub.TXPD + 1
    udp.grow(0x8000, second)
    udp[0x8000].entries[second].value = 0xD001
    udp[0x8000].entries[0].value = second
    assert _fault(udp) == (FaultCode.FRAME_TOO_LONG, 0x8000, FrameSub.FRAME_LENGTH)


def test_disabled_objects_are_left_out(udp):
    receiver(sender(udp))
    write(udp, 0xD001, Tx.NAME, "later")
    write(udp, 0x8001, FrameSub.NAME, "later")
    write(udp, 0xE000, Rx.FLAGS, 0)
    reader = PortReader(udp)
    assert [found.at for found in reader.frames()] == [0x8000]
    assert [found.at for found in reader.sent] == [0xD000]
    assert list(reader.subscriptions()) == []


def test_any_publisher_is_a_flag_or_no_netid(udp):
    receiver(udp)
    rx_pd(udp, 0xE000, 0x1600, 1)
    read = []
    for publisher, flags in ((bytes(6), 0), (b"\1\2\3\4\5\6", 0), (b"\1\2\3\4\5\6", 1)):
        write(udp, 0xE000, Rx.PUBLISHER, publisher)
        write(udp, 0xE000, Rx.FLAGS, RxFlag.ENABLED | flags)
        read += [found.record.publisher for found in PortReader(udp).subscriptions()]
    assert read == ["", "1.2.3.4.5.6", ""]


def test_writing_another_publisher_empties_the_source(udp):
    receiver(udp)
    rx_pd(udp, 0xE000, 0x1600, 1)
    write(udp, 0xE000, Rx.PUBLISHER, b"\1\2\3\4\5\6")
    write(udp, 0xE000, Rx.SOURCE, "10.0.0.7")
    read = [next(PortReader(udp).subscriptions()).record.source]
    write(udp, 0xE000, Rx.PUBLISHER, b"\1\2\3\4\5\6")
    read.append(next(PortReader(udp).subscriptions()).record.source)
    write(udp, 0xE000, Rx.PUBLISHER, b"\1\2\3\4\5\7")
    read.append(next(PortReader(udp).subscriptions()).record.source)
    assert read == ["10.0.0.7", "10.0.0.7", ""]


def test_source_of_a_received_pd_is_an_address(udp):
    receiver(udp)
    rx_pd(udp, 0xE000, 0x1600, 1)
    with pytest.raises(SdoAbortError, match="no MAC and no IPv4 address"):
        write(udp, 0xE000, Rx.SOURCE, "somewhere")


def test_times_of_on_change_switch_it_on(udp):
    sender(udp)
    for subindex, spec in (
        (Tx.ON_CHANGE_TIMEOUT, OnChangeSpec(timeout_ms=1)),
        (Tx.ON_CHANGE_INHIBIT, OnChangeSpec(inhibit_us=1)),
        (Tx.ON_CHANGE, OnChangeSpec()),
    ):
        write(udp, 0xD000, subindex, 1)
        (read,) = (found.record for found in PortReader(udp).frames())
        assert read.pds[0].trigger == TriggerSpec(on_change=spec)
        write(udp, 0xD000, subindex, 0)


def test_a_net_id_may_come_with_its_mac_address():
    dictionary = _on("ethernet://eth0")
    write(dictionary, 0x8000, FrameSub.ADDRESS_MODE, AddressMode.NET_ID)
    assert _fault(dictionary) == (FaultCode.NO_DESTINATION, 0x8000, FrameSub.DESTINATION_NETID)
    write(dictionary, 0x8000, FrameSub.DESTINATION_NETID, b"\5\5\5\5\2\1")
    for octets, mac in (
        (b"\x02\0\0\0\0\x09", "02:00:00:00:00:09"),
        (bytes(6), ""),
        (b"\x01\0\0\0\0\x09", ""),
    ):
        write(dictionary, 0x8000, FrameSub.DESTINATION_MAC, octets)
        (read,) = (found.record for found in PortReader(dictionary).frames())
        assert (read.destination, read.mac) == ("5.5.5.5.2.1", mac)


def test_subscribers_are_monitored_as_the_object_says():
    dictionary = _on("ethernet://eth0")
    write(dictionary, 0x8000, FrameSub.ADDRESS_MODE, AddressMode.MAC)
    write(dictionary, 0x8000, FrameSub.MONITORING_INTERVAL, 2500)
    write(dictionary, 0x8000, FrameSub.MONITOR_IP, b"\x0a\0\0\x09")
    (read,) = (found.record for found in PortReader(dictionary).frames())
    assert (read.monitor_interval_ms, read.monitor_ip) == (2500, "10.0.0.9")


@examples(30)
@given(stations())
def test_filled_dictionary_reads_back_as_its_station(station: StationSpec):
    assert read_back(station, filled(station)) == station


@examples(30)
@given(stations())
def test_filled_dictionary_reads_back_into_a_blank_station(station: StationSpec):
    bare = replace(station, variables=(), frames=(), subscriptions=(), sources=(), links=())
    spec = read_back(bare, filled(station))
    assert sorted(each.name for each in spec.variables) == sorted(
        each.name for each in station.variables
    )
    assert {each.name: each for each in spec.frames} == {e.name: e for e in station.frames}
    again = filled(replace(spec, sources=station.sources, links=station.links))
    assert read_back(bare, again) == spec


def test_alternates_stay_with_what_is_laid_out_as_before():
    alternates = (RxAlternateSpec(7, (SentVariableSpec("limit", "UINT"),)),)
    ports = empty()
    receiver(ports["eap0"])
    spec = read_back(BLANK, ports)
    tolerant = replace(spec, subscriptions=(replace(spec.subscriptions[0], alternates=alternates),))
    assert read_back(tolerant, ports) == tolerant
    assert read_back(tolerant, filled(tolerant)) == tolerant
    write(ports["eap0"], 0xE000, Rx.TIME_OUT, 50)
    assert read_back(tolerant, ports).subscriptions[0].alternates == alternates
    write(ports["eap0"], 0xE000, Rx.VERSION, 7)
    assert read_back(tolerant, ports).subscriptions[0].alternates == ()


def test_a_blank_station_is_a_whole_one(udp):
    assert read_back(BLANK, empty()) == BLANK
    assert read_back(BLANK, {}) == BLANK


def test_downloads_make_a_station():
    ports = empty()
    sender(ports["eap0"])
    receiver(ports["eap0"])
    assert read_back(BLANK, ports) == replace(
        BLANK,
        variables=(VariableSpec("level", "UINT"), VariableSpec("limit", "UINT", Writer.ENGINE)),
        frames=(TxFrameSpec("frame0", "eap0", "10.0.0.2", (TxPdSpec("txpd0", 1, ("level",)),)),),
        subscriptions=(RxPdSpec("rxpd0", "eap0", 1, ("limit",)),),
    )


def test_read_back_keeps_order_and_appends_new_records():
    before = replace(BLANK, variables=(VariableSpec("zebra", "UINT"), VariableSpec("ape", "UINT")))
    ports = filled(before)
    variable(ports["eap0"], 0x6002, "cat")
    variable(ports["eap1"], 0x6000, "ant")
    names = [each.name for each in read_back(before, ports).variables]
    assert names == ["zebra", "ape", "cat", "ant"]


def test_a_variable_of_two_ports_is_one_if_both_say_the_same():
    ports = empty()
    for each in ports.values():
        variable(each, 0x6000, "shared", "REAL")
    assert read_back(BLANK, ports).variables == (VariableSpec("shared", "REAL"),)
    write(ports["eap1"], 0x6000, Var.UNIT, "degC")
    with pytest.raises(DeviceFault) as caught:
        read_back(BLANK, ports)
    assert caught.value.code == FaultCode.NAME_TWICE
    assert (caught.value.port, caught.value.index) == ("eap1", 0x6000)


def test_a_name_is_given_once_in_a_port():
    ports = empty()
    variable(ports["eap0"], 0x6000, "same")
    variable(ports["eap0"], 0x7000, "same")
    with pytest.raises(DeviceFault) as caught:
        read_back(BLANK, ports)
    assert (caught.value.code, caught.value.index) == (FaultCode.NAME_TWICE, 0x7000)


def test_variables_of_a_bus_stay_and_are_described_as_they_are():
    state = VariableSpec("bus0.state", "BYTE", Writer.ENGINE)
    bus = PortSpec(
        "bus0", PortKind.BUS, InterfaceUri.parse("sim:///b.yaml"), NetId.parse("127.0.9.1.4.1")
    )
    station = replace(BLANK, ports=(*BLANK.ports, bus), variables=(state,))
    ports = empty(station)
    assert read_back(station, ports).variables == (state,)
    variable(ports["eap0"], 0x6000, "bus0.state", "BYTE")
    with pytest.raises(DeviceFault, match=r"bus0.state exists in the station, and differs"):
        read_back(station, ports)
    write(ports["eap0"], 0x6000, Var.WRITER, 1)
    assert read_back(station, ports).variables == (state,)


def test_cycle_and_phase_are_those_of_all_ports():
    ports = empty()
    for each in ports.values():
        write(each, 0xF800, Configured.DEVICE_CYCLE_TIME, 2000)
        write(each, 0xF800, Configured.PHASE, 1999)
    spec = read_back(BLANK, ports)
    assert (spec.cycle_us, spec.phase_us) == (2000, 1999)
    write(ports["eap1"], 0xF800, Configured.PHASE, 7)
    with pytest.raises(DeviceFault, match="on another port") as caught:
        read_back(BLANK, ports)
    assert (caught.value.code, caught.value.port) == (FaultCode.CYCLE_TIME, "eap1")
    write(ports["eap0"], 0xF800, Configured.PHASE, 2000)
    with pytest.raises(DeviceFault, match="not within the cycle") as caught:
        read_back(BLANK, ports)
    assert caught.value.subindex == Configured.PHASE


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
        ([(0x8001, FrameSub.NAME, "frame0")], (FaultCode.NAME_TWICE, 0x8001, FrameSub.NAME)),
        ([(0xD001, Tx.NAME, "txpd0")], (FaultCode.NAME_TWICE, 0xD001, Tx.NAME)),
        ([(0xE001, Rx.NAME, "rxpd0")], (FaultCode.NAME_TWICE, 0xE001, Rx.NAME)),
        ([(0xD001, Tx.PD_ID, 1)], (FaultCode.PD_ID_TWICE, 0xD001, Tx.PD_ID)),
        ([(0x8000, FrameSub.MODULO, 1)], (FaultCode.MODULO, 0x8000, FrameSub.MODULO)),
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
            [(0x8000, FrameSub.DIVIDER, 4), (0xD000, Tx.DIVIDER, 6)],
            (FaultCode.GATE, 0xD000, Tx.DIVIDER),
        ),
        (
            [(0x8000, FrameSub.DIVIDER, 4), (0xD000, Tx.CYCLE_TIME, 20000)],
            (FaultCode.GATE, 0xD000, Tx.CYCLE_TIME),
        ),
        (
            [
                (0x8000, FrameSub.DIVIDER, 2),
                (0x8000, FrameSub.MODULO, 1),
                (0xD000, Tx.DIVIDER, 4),
            ],
            (FaultCode.GATE, 0xD000, Tx.DIVIDER),
        ),
        (
            [(0x8000, FrameSub.MONITOR_IP, b"\x0a\0\0\2")],
            (FaultCode.MONITORING, 0x8000, FrameSub.MONITOR_IP),
        ),
        (
            [(0x8000, FrameSub.MONITORING_INTERVAL, 99)],
            (FaultCode.MONITORING, 0x8000, FrameSub.MONITORING_INTERVAL),
        ),
        (
            [(0x8000, FrameSub.MONITORING_INTERVAL, 100), (0x8000, FrameSub.ADDRESS_MODE, 3)],
            (FaultCode.MONITORING, 0x8000, FrameSub.MONITORING_INTERVAL),
        ),
        (
            [
                (0x8000, FrameSub.MONITORING_INTERVAL, 100),
                (0x8000, FrameSub.DESTINATION_IP, b"\xef\1\1\1"),
            ],
            (FaultCode.MONITORING, 0x8000, FrameSub.MONITORING_INTERVAL),
        ),
        ([(0xE001, Rx.PD_ID, 1)], (FaultCode.RECEIVED_TWICE, 0xE001, Rx.PD_ID)),
        ([(0xE001, Rx.PDO_INDEX, 0x1600)], (FaultCode.RECEIVED_TWICE, 0xE001, Rx.PDO_INDEX)),
        (
            [(0xE000, Rx.TIME_OUT, 9)],
            (FaultCode.TIME_OUT, 0xE000, Rx.TIME_OUT),
        ),
        (
            [(0xD000, Tx.POLL_REQUEST_RXPD, 0xE000)],
            (FaultCode.POLL, 0x8000, FrameSub.ADDRESS_MODE),
        ),
        (
            [(0x8000, FrameSub.ADDRESS_MODE, AddressMode.REQUESTER)],
            (FaultCode.POLL, 0x8000, FrameSub.ADDRESS_MODE),
        ),
        (
            [
                (0x8000, FrameSub.ADDRESS_MODE, AddressMode.REQUESTER),
                (0x8000, FrameSub.DIVIDER, 2),
                (0xD000, Tx.POLL_REQUEST_RXPD, 0xE000),
            ],
            (FaultCode.TRIGGERS, 0x8000, FrameSub.DIVIDER),
        ),
        (
            [
                (0x8000, FrameSub.ADDRESS_MODE, AddressMode.REQUESTER),
                (0xD000, Tx.POLL_REQUEST_RXPD, 0xE000),
                (0xD000, Tx.EVENT, 1),
            ],
            (FaultCode.TRIGGERS, 0xD000, Tx.POLL_REQUEST_RXPD),
        ),
        (
            [
                (0x8000, FrameSub.ADDRESS_MODE, AddressMode.REQUESTER),
                (0xD000, Tx.POLL_REQUEST_RXPD, 0xE000),
                (0xE000, Rx.FLAGS, 0),
            ],
            (FaultCode.POLL, 0xD000, Tx.POLL_REQUEST_RXPD),
        ),
        (
            [
                (0x8000, FrameSub.ADDRESS_MODE, AddressMode.REQUESTER),
                (0xD000, Tx.POLL_REQUEST_RXPD, 0xE000),
                (0xE000, Rx.POLL_REQUEST_TXPD, 0xD001),
            ],
            (FaultCode.POLL, 0xD000, Tx.POLL_REQUEST_RXPD),
        ),
        (
            [
                (0x8000, FrameSub.ADDRESS_MODE, AddressMode.REQUESTER),
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
def test_fault_of_a_station_names_its_object(ports, writes, fault):
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
    write(other, 0x8000, FrameSub.NAME, "other")
    write(other, 0xD000, Tx.NAME, "other")
    assert len(read_back(BLANK, ports).frames) == 3  # IDs are unique per publisher


def test_valid_polls_have_no_findings(ports):
    udp = ports["eap0"]
    write(udp, 0x8000, FrameSub.ADDRESS_MODE, AddressMode.REQUESTER)
    write(udp, 0xD000, Tx.POLL_REQUEST_RXPD, 0xE000)
    write(udp, 0xE001, Rx.POLL_REQUEST_TXPD, 0xD001)
    spec = read_back(BLANK, ports)
    assert spec.frames[0].pds[0].poll_request == "rxpd0"
    assert spec.subscriptions[1].poll_request == "txpd1"


def test_old_and_new_version_of_a_pd_are_accepted_side_by_side(ports):
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

    def test_variable_with_writer_cannot_be_received(self):
        ports = filled(self.STATION)
        udp = ports["eap0"]
        write(udp, 0x6003, 0, 0)
        mapping(udp, 0x1600, (variable(udp, 0x7000, "to"), 16))
        rx_pd(udp, 0xE000, 0x1600, 1)
        with pytest.raises(DeviceFault) as caught:
            read_back(self.STATION, ports)
        assert caught.value.code == FaultCode.WRITER
