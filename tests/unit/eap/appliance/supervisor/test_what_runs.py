from __future__ import annotations

import logging

from msgspec.structs import replace

from eap.appliance.configuration import Stored, digest_of
from eap.appliance.handover import Handover
from eap.appliance.store import Store
from eap.appliance.supervisor.what_runs import what_runs_now
from eap.pd.device import DeviceState
from tests.unit.eap.appliance.conftest import eap_port, left, right


def handover():
    return Handover(1, "/run/x", "demo", "demo.yaml", (left(), right()), ())


def store(spec, state=DeviceState.OP):
    Store("demo").save("left", Stored(base=digest_of(left()), spec=spec, state=state))


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
