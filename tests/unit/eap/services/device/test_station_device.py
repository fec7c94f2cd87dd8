"""A station's device: states, downloads, applied and rolled back configurations."""

from __future__ import annotations

import errno

import pytest
from msgspec.structs import replace

from eap.device.configuration import dump_configuration
from eap.errors import EngineGoneError, EngineRefusedError
from eap.ids import InterfaceUri, NetId
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.profiles.eap1000 import Tx
from eap.pd.device import DeviceState, FaultCode
from eap.pd.spec import TriggerSpec, TxFrameSpec, TxPdSpec, VariableSpec
from eap.runtime import draft
from eap.runtime.store import StationStore, digest_of, effective, plant_folder
from tests.support.stationengine import make_device
from tests.support.virtualtime import run_virtual

TXPD, FRAME, CONTROL, STATUS = 0xD000, 0x8000, 0xF200, 0xF100


@pytest.fixture
def spec(stations):
    return stations[0]


def with_more(spec):
    """The station with one variable more in its PD."""
    (frame,) = spec.frames
    (pd,) = frame.pds
    pd = replace(pd, variables=(*pd.variables, "more"), version=1)
    return replace(
        spec,
        variables=(*spec.variables, VariableSpec("more", "UDINT")),
        frames=(replace(frame, pds=(pd,)),),
    )


async def write(device, index, subindex, value, size=2, **more):
    await device.download("eap0", index, subindex, value.to_bytes(size, "little"), **more)


def word(device, index, subindex) -> int:
    return int.from_bytes(device.upload("eap0", index, subindex), "little")


@pytest.mark.parametrize("state", [DeviceState.PREOP, DeviceState.SAFEOP, DeviceState.OP])
def test_it_begins_as_the_engine_does(spec, state):
    device, engine = make_device(spec, state)
    assert device.status == (state, None)
    assert word(device, STATUS, 1) == state
    assert device.spec == spec
    assert engine.calls == []
    assert StationStore("demo", "left").configuration.read() is None


def test_walk_through_the_states(spec):
    device, engine = make_device(spec)

    async def script():
        for state in (2, 4, 8, 4, 8, 2, 8):
            assert await device.request_state(state) == (state, None)
            assert engine.state == state == word(device, STATUS, 1)

    run_virtual(script())
    assert not any(call.startswith("configure") for call in engine.calls)


def test_downloads_in_preop_run_from_safeop_on(spec):
    device, engine = make_device(spec)

    async def script():
        with pytest.raises(SdoAbortError) as caught:
            await write(device, TXPD, Tx.PD_ID, 77)
        assert caught.value.code == AbortCode.DEVICE_STATE
        await write(device, CONTROL, 1, 2)
        await write(device, TXPD, Tx.PD_ID, 77)
        assert engine.spec == device.spec == spec
        await write(device, CONTROL, 1, 8)

    run_virtual(script())
    (frame,) = engine.spec.frames
    assert [pd.pd_id for pd in frame.pds] == [77]
    assert device.spec == engine.spec
    assert engine.state is DeviceState.OP
    assert effective("demo", (spec,)) == ((engine.spec, DeviceState.OP),)


def test_next_services_find_the_same_dictionary(spec):
    device, engine = make_device(spec)

    async def script():
        await write(device, CONTROL, 1, 2)
        await write(device, 0x6010, 4, int.from_bytes(b"UINT", "little"), 4)  # used by nothing
        await write(device, CONTROL, 1, 4)

    run_virtual(script())
    assert 0x6010 in device.dictionaries["eap0"]
    again, _ = make_device(engine.spec, DeviceState.SAFEOP)
    assert dump_configuration(again.dictionaries["eap0"]) == dump_configuration(
        device.dictionaries["eap0"]
    )


def restarted(device):
    """The device of the next services process, in PreOp."""
    return make_device(device.spec, DeviceState.PREOP)[0]


def content(device):
    return dump_configuration(device.dictionaries["eap0"])


async def download_three(device):
    await write(device, CONTROL, 1, 2)
    await write(device, TXPD, Tx.PD_ID, 77)
    await write(device, 0x6010, 4, int.from_bytes(b"UINT", "little"), 4)
    whole = device.upload("eap0", FRAME, 0, complete=True)
    await device.download("eap0", FRAME, 0, whole, complete=True)


def test_next_services_find_downloads_in_preop_that_were_not_taken(spec):
    device, _ = make_device(spec)
    unchanged = content(device)
    run_virtual(download_three(device))
    again = restarted(device)
    assert content(again) == content(device) != unchanged
    assert again.spec == spec

    async def script():
        await write(again, TXPD, Tx.PD_ID, 78)  # it goes on where the one before ended
        await write(restarted(again), CONTROL, 1, 4)

    run_virtual(script())
    stored = StationStore("demo", "left").configuration.read()
    assert [pd.pd_id for frame in stored.spec.frames for pd in frame.pds] == [78]


def test_refused_download_in_preop_is_not_repeated(spec):
    device, _ = make_device(spec)

    async def script():
        await write(device, CONTROL, 1, 2)
        with pytest.raises(SdoAbortError):
            await write(device, TXPD, Tx.PD_ID, 77, 1)
        await write(device, TXPD, Tx.PD_ID, 78)

    run_virtual(script())
    assert content(restarted(device)) == content(device)


def test_downloads_that_were_taken_are_not_repeated(spec):
    device, engine = make_device(spec)

    async def script():
        await download_three(device)
        await device.request_state(4)
        await device.request_state(2)

    run_virtual(script())
    again, _ = make_device(engine.spec, DeviceState.PREOP)
    assert content(again) == content(device)
    assert StationStore("demo", "left").draft.read(digest_of(engine.spec)) is None


def test_apply_in_preop_replaces_downloads(spec):
    device, engine = make_device(spec)

    async def script():
        await download_three(device)
        await device.apply(with_more(spec))

    run_virtual(script())
    again, _ = make_device(engine.spec, DeviceState.PREOP)
    assert content(again) == content(device)


def test_downloads_of_another_configuration_are_left_out(spec):
    run_virtual(download_three(make_device(spec)[0]))
    other = replace(spec, frames=())
    again, _ = make_device(other, DeviceState.PREOP)
    assert content(again) == content(make_device(other, DeviceState.OP)[0])


def test_many_downloads_are_kept_in_bounded_space(spec, monkeypatch):
    monkeypatch.setattr(draft, "SHORTEN_AT", 300)
    device, _ = make_device(spec)

    async def script():
        await write(device, CONTROL, 1, 2)
        for number in range(50):
            await write(device, TXPD, Tx.PD_ID, number + 1)
            assert content(restarted(device)) == content(device)

    run_virtual(script())
    found = StationStore("demo", "left").draft.read(digest_of(spec))
    assert found.objects
    assert len(found.downloads) < 10


def test_downloads_that_cannot_be_kept_are_warned_of_once(spec, caplog):
    device, _ = make_device(spec)
    folder = plant_folder("demo")
    folder.mkdir(parents=True)
    (folder / "drafts").write_text("a file in place of the folder")
    run_virtual(download_three(device))
    (warning,) = [each.message for each in caplog.records if "cannot be kept" in each.message]
    assert warning.startswith("station left: downloads in PREOP cannot be kept in ")
    (folder / "drafts").unlink()
    run_virtual(write(device, TXPD, Tx.PD_ID, 79))
    assert content(restarted(device)) == content(device)


@pytest.mark.parametrize("cut", range(1, 40, 6))
def test_line_that_a_kill_has_cut_is_left_out(spec, cut):
    device, _ = make_device(spec)

    async def script():
        await write(device, CONTROL, 1, 2)
        await write(device, TXPD, Tx.PD_ID, 77)
        before = content(device)
        await write(device, TXPD, Tx.PD_ID, 78)
        path = plant_folder("demo") / "drafts" / "left.jsonl"
        path.write_bytes(path.read_bytes()[:-cut])
        again = restarted(device)
        assert content(again) == before
        await write(again, TXPD, Tx.PD_ID, 79)
        assert content(restarted(again)) == content(again)

    run_virtual(script())


def test_damaged_downloads_are_put_aside_with_a_warning(spec, caplog):
    device, _ = make_device(spec)
    unchanged = content(device)
    run_virtual(download_three(device))
    path = plant_folder("demo") / "drafts" / "left.jsonl"
    path.write_bytes(path.read_bytes().replace(b'"index"', b'"indox"', 1))
    assert content(restarted(device)) == unchanged
    assert "downloads in PREOP cannot be read" in caplog.text
    assert path.with_suffix(".damaged").exists()


def test_refused_state_says_why_and_by_which_object(spec):
    device, engine = make_device(spec)

    async def script():
        await device.request_state(2)
        await write(device, TXPD, Tx.PDO_INDEX, 0)
        refused = await device.request_state(8)
        assert refused.state is DeviceState.PREOP
        assert (refused.fault.code, refused.fault.index) == (FaultCode.NO_PDO, TXPD)
        with pytest.raises(SdoAbortError, match="0xD000:01") as caught:
            await write(device, CONTROL, 1, 8)
        assert caught.value.code == AbortCode.DEVICE_STATE
        await write(device, TXPD, Tx.PDO_INDEX, 0x1A00)
        assert await device.request_state(8) == (8, None)

    run_virtual(script())
    assert engine.calls == ["left PREOP", "left OP"]


@pytest.mark.parametrize(
    ("wanted", "code"), [(1, FaultCode.INVALID_REQUEST), (3, FaultCode.UNKNOWN_STATE)]
)
def test_state_that_cannot_be_requested(spec, wanted, code):
    device, engine = make_device(spec)
    refused = run_virtual(device.request_state(wanted))
    assert (refused.state, refused.fault.code) == (DeviceState.OP, code)
    assert engine.calls == []


def test_engine_that_does_not_take_it_leaves_the_device_in_preop(spec):
    device, engine = make_device(spec)

    async def script():
        await device.request_state(2)
        await write(device, TXPD, Tx.PD_ID, 77)
        engine.failure = EngineRefusedError("no memory")
        refused = await device.request_state(8)
        assert refused.state is DeviceState.PREOP
        assert "no memory" in refused.fault.text
        assert word(device, STATUS, 2) == FaultCode.NOT_RUNNING
        assert word(device, TXPD, Tx.PD_ID) == 77  # to be tried again
        assert await device.request_state(8) == (8, None)

    run_virtual(script())
    assert engine.spec.frames[0].pds[0].pd_id == 77


def test_engine_that_does_not_change_its_state(spec):
    device, engine = make_device(spec, DeviceState.SAFEOP)

    async def script():
        engine.failure = EngineGoneError("gone")
        refused = await device.request_state(8)
        assert (refused.state, refused.fault.code) == (DeviceState.SAFEOP, FaultCode.NOT_RUNNING)
        engine.failure = EngineGoneError("gone")
        assert await device.request_state(2) == (2, None)
        engine.calls.clear()
        await device.resend()

    run_virtual(script())
    assert engine.calls == ["configure left", "left PREOP"]


def test_port_that_the_supervisor_opened_cannot_be_changed_by_downloads(spec):
    device, _ = make_device(spec, DeviceState.PREOP)

    async def script():
        await write(device, 0xF810, 7, 1, 1)
        refused = await device.request_state(4)
        assert refused.fault.code == FaultCode.PORT
        assert "port eap0: tcp False -> True: 'eapctl apply'" in refused.fault.text

    run_virtual(script())


@pytest.mark.parametrize("state", [DeviceState.PREOP, DeviceState.OP])
def test_apply_adds_changes_and_removes_ports(spec, state):
    device, _ = make_device(spec, state)
    more = replace(
        spec, ports=(replace(spec.ports[0], name="eap1", net_id=NetId.parse("9.1.1.1.1.1")),
                     *spec.ports),
    )  # fmt: skip
    changed = replace(more, ports=(replace(more.ports[0], tcp=True), *spec.ports))
    first = device.dictionaries["eap0"]

    async def script():
        for wanted in (more, changed):
            plan, fault = await device.apply(wanted)
            assert (plan.refused, fault) == ([], None)
            assert list(device.dictionaries) == ["eap1", "eap0"]
        assert device.dictionaries["eap0"] is first
        assert (await device.request_state(8)).fault is None
        assert device.spec == changed
        await device.apply(spec)
        assert list(device.dictionaries) == ["eap0"]
        plan, fault = await device.roll_back()
        assert (plan.refused, fault) == ([], None)
        assert list(device.dictionaries) == ["eap1", "eap0"]
        assert device.spec == changed

    run_virtual(script())


@pytest.mark.parametrize("state", [DeviceState.PREOP, DeviceState.OP])
def test_apply_changes_a_running_station(spec, state):
    device, engine = make_device(spec, state)
    wanted = with_more(spec)

    async def script():
        plan, fault = await device.apply(wanted)
        assert fault is None
        assert plan.refused == []
        names = {change.name for _, change in plan.changes}
        assert "TxPD 0 (state): Version" in names
        again, fault = await device.apply(wanted)
        assert again.is_empty
        assert fault is None

    run_virtual(script())
    assert engine.spec == device.spec == wanted
    assert engine.calls == ["configure left"]
    assert engine.state is state
    assert word(device, TXPD, Tx.VERSION) == 1
    assert effective("demo", (spec,)) == ((wanted, DeviceState.OP if state == 8 else state),)


def test_apply_keeps_the_indexes_of_unchanged_objects(spec):
    device, engine = make_device(spec)
    (frame,) = spec.frames
    first = TxPdSpec("first", 6, ("ticks",), trigger=TriggerSpec(divider=2))
    wanted = replace(spec, frames=(replace(frame, pds=(first, *frame.pds)),))
    run_virtual(device.apply(wanted))
    assert engine.spec == wanted
    names = [device.upload("eap0", index, Tx.NAME) for index in (TXPD, TXPD + 1)]
    assert names == [b"state", b"first"]


def test_plan_changes_nothing(spec):
    device, engine = make_device(spec)
    plan = run_virtual(device.plan(with_more(spec)))
    assert plan.changes
    assert not plan.is_empty
    assert device.spec == spec
    assert engine.calls == []
    assert run_virtual(device.plan(spec)).is_empty


def test_apply_of_an_invalid_change_changes_nothing(spec):
    device, engine = make_device(spec)
    everywhere = InterfaceUri.parse("udp://0.0.0.0")
    other_port = replace(spec, ports=(replace(spec.ports[0], interface=everywhere),))
    (frame,) = spec.frames
    unknown = replace(spec, frames=(replace(frame, pds=(TxPdSpec("x", 1, ("ticks",) * 800),)),))

    async def script():
        plan, fault = await device.apply(other_port)
        assert (len(plan.refused), fault) == (1, None)
        plan, fault = await device.apply(unknown)
        assert (len(plan.refused), fault) == (1, None)

    run_virtual(script())
    assert engine.calls == []
    assert device.spec == spec
    assert StationStore("demo", "left").configuration.read() is None


def test_apply_that_the_engine_refuses_changes_nothing(spec):
    device, engine = make_device(spec)
    before = dump_configuration(device.dictionaries["eap0"])

    async def script():
        engine.failure = EngineRefusedError("no memory")
        plan, fault = await device.apply(with_more(spec))
        assert plan.changes
        assert "no memory" in fault.text

    run_virtual(script())
    assert device.spec == engine.spec == spec
    assert dump_configuration(device.dictionaries["eap0"]) == before
    assert effective("demo", (spec,)) == ((spec, DeviceState.OP),)


def test_rollback_goes_back_and_forth(spec):
    device, engine = make_device(spec)
    wanted = with_more(spec)

    async def script():
        plan, _ = await device.roll_back()
        assert plan.refused == ["there is nothing to go back to: it has run nothing else"]
        before = dump_configuration(device.dictionaries["eap0"])
        await device.apply(wanted)
        after = dump_configuration(device.dictionaries["eap0"])
        plan, fault = await device.roll_back()
        assert plan.changes
        assert fault is None
        assert device.spec == engine.spec == spec
        assert dump_configuration(device.dictionaries["eap0"]) == before
        await device.roll_back()
        assert device.spec == engine.spec == wanted
        assert dump_configuration(device.dictionaries["eap0"]) == after

    run_virtual(script())
    again, engine = make_device(wanted)
    run_virtual(again.roll_back())
    assert engine.spec == spec


def test_spec_too_large_for_dictionaries_runs_without_downloads(spec, caplog):
    names = [f"v{number}" for number in range(255)]
    variables = tuple(VariableSpec(name, "USINT") for name in names)
    frame = TxFrameSpec("out", "eap0", "127.9.2.2", (TxPdSpec("all", 1, tuple(names)),))
    crowded = replace(spec, variables=variables, sources=(), frames=(frame,))
    device, engine = make_device(crowded)
    assert "station left: incomplete dictionaries" in caplog.text
    assert device.status == (DeviceState.OP, None)

    async def script():
        await device.request_state(2)
        assert await device.request_state(8) == (8, None)
        assert engine.spec == crowded
        await device.request_state(2)
        await write(device, TXPD, Tx.PD_ID, 77)
        refused = await device.request_state(8)
        assert refused.fault.code == FaultCode.NO_ROOM
        await device.apply(spec)
        assert await device.request_state(8) == (8, None)

    run_virtual(script())
    assert engine.spec == spec


def changeable(spec):
    (frame,) = spec.frames
    (pd,) = frame.pds
    return replace(spec, frames=(replace(frame, pds=(replace(pd, changeable=True),)),))


def test_entry_that_may_be_changed_while_it_runs(spec):
    device, engine = make_device(changeable(spec))

    async def script():
        await write(device, TXPD, Tx.PD_ID, 77)
        assert engine.calls == ["configure left"]
        assert engine.spec.frames[0].pds[0].pd_id == 77
        assert device.spec == engine.spec
        engine.failure = EngineRefusedError("no memory")
        with pytest.raises(SdoAbortError, match="no memory"):
            await write(device, TXPD, Tx.PD_ID, 78)
        assert word(device, TXPD, Tx.PD_ID) == 77
        with pytest.raises(SdoAbortError) as caught:
            await write(device, TXPD, Tx.VERSION, 1)
        assert caught.value.code == AbortCode.DEVICE_STATE

    run_virtual(script())
    assert engine.spec.frames[0].pds[0].pd_id == 77
    assert effective("demo", (changeable(spec),))[0].spec == engine.spec


def test_change_while_it_runs_that_cannot_be_is_refused_by_the_dictionary(spec):
    device, engine = make_device(changeable(spec))
    other = replace(spec.frames[0].pds[0], name="other", pd_id=8)
    (frame,) = changeable(spec).frames
    both = replace(spec, frames=(replace(frame, pds=(*frame.pds, other)),))

    async def script():
        await device.apply(both)
        engine.calls.clear()
        with pytest.raises(SdoAbortError, match="PD ID is used twice") as caught:
            await write(device, TXPD, Tx.PD_ID, 8)
        assert caught.value.code == AbortCode.PARAMETER
        assert word(device, TXPD, Tx.PD_ID) == 7

    run_virtual(script())
    assert engine.calls == []


def test_device_that_cannot_be_kept_has_a_finding(spec, monkeypatch):
    def full(path, octets):
        raise OSError(errno.ENOSPC, "No space left on device")

    device, _ = make_device(spec)
    assert device.findings() == []
    monkeypatch.setattr("eap.runtime.store.replace_file", full)
    run_virtual(device.request_state(DeviceState.SAFEOP))
    (only,) = device.findings()
    assert (only["severity"], only["where"]) == ("error", "left")
    assert only["what"].endswith(
        ": No space left on device; a start restores the configuration before"
    )
    assert only["advice"] == "make room there, then 'eapctl state left SAFEOP'"
