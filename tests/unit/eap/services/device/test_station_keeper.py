"""Running and stored configuration change together."""

from __future__ import annotations

import asyncio
import errno

import pytest
from msgspec.structs import replace

from eap.errors import EngineGoneError, EngineRefusedError, EnvironmentalError
from eap.pd.device import DeviceFault, DeviceState, FaultCode
from eap.pd.spec import RxAlternateSpec, SentVariableSpec, StationSpec
from eap.runtime.store import (
    Configuration,
    StationFile,
    StationStore,
    digest_of,
    effective,
    state_root,
)
from eap.services.device.station_keeper import StationKeeper
from tests.support.stationengine import StationEngine
from tests.support.virtualtime import run_virtual
from tests.unit.eap.conftest import right

OLD, NEW = {"eap0": "old"}, {"eap0": "new"}


def make_keeper(spec: StationSpec, engine: StationEngine) -> StationKeeper:
    file = StationStore("demo", spec.name).configuration
    return StationKeeper(spec, DeviceState.OP, file, engine)


@pytest.fixture
def spec(stations):
    return stations[0]


@pytest.fixture
def changed(spec):
    return replace(spec, cycle_us=20_000)


@pytest.fixture
def engine(spec):
    return StationEngine(spec)


@pytest.fixture
def keeper(spec, engine):
    return StationKeeper(
        spec, DeviceState.OP, StationStore("demo", spec.name).configuration, engine
    )


def kept():
    return StationStore("demo", "left").configuration.read()


def test_unchanged_station_is_not_stored(keeper, spec):
    assert (keeper.spec, keeper.state, keeper.objects, keeper.previous) == (
        spec,
        DeviceState.OP,
        {},
        None,
    )
    assert not state_root().exists()


def test_change_is_kept_and_runs(keeper, engine, spec, changed):
    told = []
    keeper.on_change.append(told.append)
    run_virtual(keeper.change(changed, NEW))
    assert engine.spec == keeper.spec == changed
    assert told == [changed]
    stored = kept()
    assert (stored.spec, stored.objects, stored.base) == (changed, NEW, digest_of(spec))
    assert (stored.previous.spec, stored.previous.objects) == (spec, {})
    assert effective("demo", (spec,)) == ((changed, DeviceState.OP),)


def test_next_keeper_goes_on_from_there(keeper, engine, spec, changed):
    run_virtual(keeper.change(changed, NEW))
    again = StationKeeper(
        changed, DeviceState.OP, StationStore("demo", changed.name).configuration, engine
    )
    assert (again.objects, again.previous.spec) == (NEW, spec)
    run_virtual(again.change(spec, OLD))
    assert kept().base == digest_of(spec)
    assert kept().previous.spec == changed


def test_stored_objects_of_another_spec_are_ignored(keeper, engine, spec, changed):
    run_virtual(keeper.change(changed, NEW))
    assert (
        StationKeeper(
            spec, DeviceState.OP, StationStore("demo", spec.name).configuration, engine
        ).objects
        == {}
    )


def test_change_is_stored_before_the_engine_request(keeper, engine, changed):
    async def script():
        engine.gate = asyncio.Event()
        changing = asyncio.ensure_future(keeper.change(changed, NEW))
        await engine.asked.wait()
        assert kept().spec == changed
        engine.gate.set()
        await changing

    run_virtual(script())


@pytest.mark.parametrize("error", [EngineRefusedError("no room"), EngineGoneError("it is gone")])
def test_spec_that_the_engine_refuses_is_not_stored(keeper, engine, spec, changed, error):
    engine.failure = error
    with pytest.raises(DeviceFault, match=str(error)) as caught:
        run_virtual(keeper.change(changed, NEW))
    assert caught.value.code == FaultCode.NOT_RUNNING
    assert keeper.spec == kept().spec == spec
    assert keeper.previous is None
    assert effective("demo", (spec,))[0].spec == spec


def test_spec_that_cannot_be_stored_does_not_run(keeper, engine, changed, monkeypatch):
    def full(self, stored):
        raise EnvironmentalError("disk full")

    monkeypatch.setattr(StationFile, "save", full)
    with pytest.raises(DeviceFault, match="disk full"):
        run_virtual(keeper.change(changed, NEW))
    assert engine.calls == []
    assert keeper.unsaved is None  # what runs is still what was kept


def test_restarted_engine_gets_the_configuration_again(keeper, engine, spec, changed):
    engine.failure = EngineGoneError("it is gone")
    with pytest.raises(DeviceFault):
        run_virtual(keeper.change(changed, NEW))
    engine.spec = changed  # it had been started with it
    engine.failure = EngineRefusedError("not yet")
    run_virtual(keeper.resend())
    run_virtual(keeper.resend())
    assert engine.spec == spec
    engine.spec, engine.state = changed, DeviceState.PREOP  # it missed what came before its start
    run_virtual(keeper.resend())
    assert (engine.spec, engine.state) == (spec, DeviceState.OP)


def test_other_objects_of_the_same_specification_are_kept_without_the_engine(keeper, engine, spec):
    run_virtual(keeper.change(spec, NEW))
    assert engine.calls == []
    assert kept().objects == NEW
    before = kept()
    run_virtual(keeper.change(spec, NEW))
    assert kept() == before


def test_states_are_kept(keeper, engine, spec):
    run_virtual(keeper.change_state(DeviceState.OP))
    assert engine.calls == []
    run_virtual(keeper.change_state(DeviceState.PREOP))
    assert engine.state is keeper.state is kept().state is DeviceState.PREOP
    assert effective("demo", (spec,)) == ((spec, DeviceState.PREOP),)


def test_way_up_can_fail_and_way_down_cannot(keeper, engine, caplog):
    engine.failure = EngineGoneError("it is gone")
    run_virtual(keeper.change_state(DeviceState.PREOP))
    assert "station left: PREOP not requested from the engine: it is gone" in caplog.text
    assert keeper.state is kept().state is DeviceState.PREOP
    engine.failure = EngineGoneError("it is still gone")
    with pytest.raises(DeviceFault, match="still gone"):
        run_virtual(keeper.change_state(DeviceState.OP))
    assert keeper.state is kept().state is DeviceState.PREOP
    run_virtual(keeper.resend())
    assert engine.state is DeviceState.PREOP


def test_state_that_cannot_be_stored_is_reported(keeper, engine, monkeypatch, caplog):
    def full(self, stored):
        raise EnvironmentalError("disk full")

    monkeypatch.setattr(StationFile, "save", full)
    run_virtual(keeper.change_state(DeviceState.SAFEOP))
    assert engine.state is keeper.state is DeviceState.SAFEOP
    assert "disk full; a start restores the configuration before" in caplog.text
    engine.failure = EngineRefusedError("no")
    with pytest.raises(DeviceFault, match="disk full"):
        run_virtual(keeper.change(replace(keeper.spec, cycle_us=30_000), NEW))


def versions() -> tuple[StationSpec, StationSpec]:
    """A station before and after its PD changes."""
    old = right()
    return old, replace(old, subscriptions=(replace(old.subscriptions[0], version=9),))


def tolerant(spec: StationSpec) -> StationSpec:
    """The same with an alternate."""
    alternate = RxAlternateSpec(77, (SentVariableSpec("ticks", "UINT"),))
    return replace(spec, subscriptions=(replace(spec.subscriptions[0], alternates=(alternate,)),))


def going(old: StationSpec, engine: StationEngine) -> StationKeeper:
    return make_keeper(old, engine)


def test_steps_of_one_change_have_one_way_back(engine):
    old, new = versions()
    keeper = going(old, engine)
    applied = []
    for spec, objects in ((tolerant(old), OLD), (tolerant(new), NEW), (new, NEW)):
        run_virtual(keeper.change(spec, objects, cause="1", applied=True))
        assert keeper.previous == Configuration(base=digest_of(old), spec=old)
        assert (keeper.cause, keeper.undone) == ("1", False)
        applied.append(StationStore("demo", "right").configuration.read().applied)
    assert applied == ["", digest_of(new), digest_of(new)]


def test_way_back_and_forth(engine):
    old, new = versions()
    keeper = going(old, engine)
    run_virtual(keeper.change(new, NEW, cause="1"))
    for goal, objects, undone in ((old, OLD, True), (new, NEW, False), (old, OLD, True)):
        before = Configuration(base=digest_of(old), spec=keeper.spec, objects=keeper.objects)
        run_virtual(keeper.roll_back(tolerant(keeper.spec), keeper.objects))
        run_virtual(keeper.roll_back(tolerant(goal), objects))
        run_virtual(keeper.roll_back(goal, objects))
        assert keeper.previous == before
        assert (keeper.cause, keeper.undone) == ("1", undone)
        again = going(keeper.spec, engine)
        assert (again.previous, again.cause, again.undone) == (before, "1", undone)


def test_change_that_was_taken_back_is_made_again(engine):
    old, new = versions()
    keeper = going(old, engine)
    run_virtual(keeper.change(new, NEW, cause="1"))
    run_virtual(keeper.roll_back(old, OLD))
    run_virtual(keeper.change(new, NEW, cause="1"))
    assert (keeper.previous.spec, keeper.undone) == (old, False)


def test_changes_of_a_tool_are_changes_of_their_own(engine):
    old, new = versions()
    keeper = going(old, engine)
    run_virtual(keeper.change(old, OLD))
    assert (keeper.previous, keeper.cause) == (None, "")  # all that is new is that it is kept
    run_virtual(keeper.change(new, NEW))
    first = keeper.cause
    assert first
    run_virtual(keeper.change(new, NEW))
    assert keeper.cause == first
    run_virtual(keeper.change(new, OLD))
    assert keeper.cause > first
    assert (keeper.previous.spec, keeper.previous.objects) == (new, NEW)


def test_state_that_cannot_be_kept_is_shown_until_it_is(keeper, monkeypatch, caplog):
    def full(path, octets):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("eap.runtime.store.replace_file", full)
        for state in (DeviceState.SAFEOP, DeviceState.PREOP):
            run_virtual(keeper.change_state(state))
    assert len(caplog.records) == 1
    assert keeper.unsaved.reason.endswith("No space left on device; make room there")
    run_virtual(keeper.change_state(DeviceState.PREOP))
    assert (keeper.unsaved, kept().state) == (None, DeviceState.PREOP)
