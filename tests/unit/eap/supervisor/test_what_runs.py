from __future__ import annotations

import logging

from msgspec.structs import replace

from eap.pd.device import DeviceState
from eap.pd.spec import PortKind, PortSpec, RxPdSpec, TxFrameSpec, TxPdSpec
from eap.runtime.handover import Handover
from eap.runtime.store import StationStore, Stored, digest_of
from eap.supervisor.what_runs import what_runs_now, why_not_built
from tests.unit.eap.conftest import eap_port, left, right


def handover():
    return Handover(1, "/run/x", "demo", "demo.yaml", (left(), right()), ())


def store(spec, state=DeviceState.OP):
    StationStore("demo", "left").configuration.save(
        Stored(base=digest_of(left()), spec=spec, state=state)
    )


def test_without_any_configuration_the_plant_file_runs():
    found = what_runs_now(handover())
    assert found == replace(handover(), states={"left": DeviceState.OP, "right": DeviceState.OP})


def test_stations_that_start_in_preop():
    store(left(), DeviceState.SAFEOP)
    found = what_runs_now(replace(handover(), first_state=DeviceState.PREOP))
    assert found.states == {"left": DeviceState.SAFEOP, "right": DeviceState.PREOP}


def test_what_was_configured_last_runs_in_the_state_asked_for():
    changed = replace(left(), frames=())
    store(changed, DeviceState.SAFEOP)
    found = what_runs_now(handover())
    assert found.stations == (changed, right())
    assert found.states == {"left": DeviceState.SAFEOP, "right": DeviceState.OP}


def test_what_needs_other_sockets_does_not_run(caplog):
    store(left(eap_port(9)), DeviceState.SAFEOP)
    with caplog.at_level(logging.WARNING):
        found = what_runs_now(handover())
    assert found.stations == (left(), right())
    assert "station left: the plant file runs: port eap0: interface" in caplog.text


def test_what_no_engine_can_run_does_not_run(caplog):
    store(replace(left(), variables=()))
    with caplog.at_level(logging.WARNING):
        found = what_runs_now(handover())
    assert found.stations == (left(), right())
    assert "station left: the plant file runs: it cannot be built: KeyError" in caplog.text


BUS = PortSpec("bus0", PortKind.BUS, "sim://x.yaml", "1.2.3.4.6.1")


def test_whatever_a_plant_file_says_can_be_built():
    for interface in ("udp://127.9.2.1", "ethernet://eth7", "tcp://127.9.2.1"):
        spec = left(eap_port(1, interface))
        assert why_not_built(replace(spec, ports=(*spec.ports, BUS))) == []
    assert why_not_built(right()) == []


def test_what_does_not_fit_together_is_told():
    unknown = replace(right(), subscriptions=(RxPdSpec("a", "eap0", 1, ("nothing",)),))
    assert why_not_built(unknown) == ["it cannot be built: KeyError: 'nothing'"]
    many = tuple(TxPdSpec(f"p{n}", n, ("name",)) for n in range(200))
    (reason,) = why_not_built(replace(left(), frames=(TxFrameSpec("f", "eap0", "10.0.0.1", many),)))
    assert reason.startswith("it cannot be built: ")
