from __future__ import annotations

import pytest
from hypothesis import given, settings
from msgspec.structs import replace

from eap.device.eap_read import read_back
from eap.device.fault import DeviceFault, FaultCode
from eap.od.profiles.eap1000keys import Configured, Rx, Var
from eap.pd.spec import (
    PortKind,
    PortSpec,
    RxAlternateSpec,
    RxPdSpec,
    StationSpec,
    TakenVariableSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Writer,
)
from tests.support.downloads import receiver, sender, variable, write
from tests.support.stations import BLANK, empty, filled, stations


@settings(max_examples=30)
@given(stations())
def test_what_was_filled_from_a_station_reads_back_as_that_station(station: StationSpec):
    assert read_back(station, filled(station)) == station


@settings(max_examples=30)
@given(stations())
def test_what_was_filled_reads_back_alike_into_a_blank_station(station: StationSpec):
    bare = replace(station, variables=(), frames=(), subscriptions=(), sources=(), links=())
    spec = read_back(bare, filled(station))
    assert sorted(each.name for each in spec.variables) == sorted(
        each.name for each in station.variables
    )
    assert {each.name: each for each in spec.frames} == {e.name: e for e in station.frames}
    again = filled(replace(spec, sources=station.sources, links=station.links))
    assert read_back(bare, again) == spec


def test_alternates_stay_with_what_is_laid_out_as_before():
    alternates = (RxAlternateSpec(7, (TakenVariableSpec("limit", "UINT"),)),)
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


def test_what_stood_in_the_station_keeps_its_place_and_new_things_come_behind():
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
    bus = PortSpec("bus0", PortKind.BUS, "sim:///b.yaml", "127.0.9.1.4.1")
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
