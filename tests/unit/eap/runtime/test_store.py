"""Configurations on disk: what runs after what, and what a kill or damage leaves."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest
from msgspec.structs import replace

from eap.ams.spec import AccessRule, AccessService, HopSpec, RouteSpec, RoutingSpec, TransportKind
from eap.config.load import load
from eap.device.eap_dictionary import EapDictionary
from eap.device.eap_spec import read_back
from eap.errors import ConfigError, EnvironmentalError
from eap.ids import decode_value, encode_value
from eap.od.slave_config import IdnWrite, SdoWrite, SlaveConfig
from eap.pd.device import DeviceState
from eap.pd.spec import RxAlternateSpec, SentVariableSpec
from eap.runtime import store as module
from eap.runtime.device_change import fill_all
from eap.runtime.durable import seal
from eap.runtime.store import (
    VERSION,
    AppliedRouting,
    Configuration,
    Effective,
    StationFile,
    StationStore,
    Stored,
    adopt_plant_file,
    digest_of,
    effective,
    lean,
    plant_folder,
    state_root,
)
from tests.support.vectors import FOLDER as VECTORS


def kept(station: str) -> StationFile[Stored]:
    return StationStore("demo", station).configuration


def changed(spec, comment: str = "changed"):
    first, *others = spec.variables
    return replace(spec, variables=(replace(first, comment=comment), *others))


def configured(spec, *, state: DeviceState = DeviceState.OP) -> Stored:
    """Return the stored configuration of a station after a change."""
    return Stored(base=digest_of(spec), spec=changed(spec), objects={"eap0": 1}, state=state)


def test_order_of_directories(monkeypatch):
    monkeypatch.setenv("EAP_STATE_DIR", "/x")
    monkeypatch.setenv("XDG_STATE_HOME", "/y")
    monkeypatch.setenv("HOME", "/h")
    assert state_root() == Path("/x")
    monkeypatch.delenv("EAP_STATE_DIR")
    assert state_root() == Path("/y/eap")
    monkeypatch.delenv("XDG_STATE_HOME")
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    assert state_root() == Path("/var/lib/eap")
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert state_root() == Path("/h/.local/state/eap")


def test_nothing_is_written_for_stations_that_never_changed(stations):
    left, right = stations
    both = (Effective(left, DeviceState.OP), Effective(right, DeviceState.OP))
    assert effective("demo", stations) == both
    assert effective("demo", (left,), DeviceState.PREOP) == (Effective(left, DeviceState.PREOP),)
    assert not state_root().exists()


def test_effective_returns_stored_configuration(stations):
    left, right = stations
    kept("left").save(configured(left, state=DeviceState.PREOP))
    assert kept("left").read() == configured(left, state=DeviceState.PREOP)
    assert kept("right").read() is None
    assert effective("demo", stations) == (
        Effective(changed(left), DeviceState.PREOP),
        Effective(right, DeviceState.OP),
    )
    assert effective("other", stations)[0].spec == left


def test_edited_plant_file_runs_and_the_rest_is_kept_for_a_rollback(stations, caplog):
    left, _ = stations
    kept("left").save(configured(left, state=DeviceState.PREOP))
    edited = changed(left, "edited")
    assert effective("demo", (edited,)) == (Effective(edited, DeviceState.OP),)
    assert "station left: the plant file was edited" in caplog.text
    now = kept("left").read()
    assert now is not None
    assert now.base == digest_of(edited)
    assert now.previous is not None
    assert (now.previous.spec, now.previous.objects) == (changed(left), {"eap0": 1})
    caplog.clear()
    assert effective("demo", (edited,)) == (Effective(edited, DeviceState.OP),)
    assert not caplog.text


def test_plant_file_that_caught_up_changes_nothing(stations, caplog):
    left, _ = stations
    before = configured(left, state=DeviceState.SAFEOP)
    kept("left").save(before)
    assert effective("demo", (changed(left),)) == (Effective(changed(left), DeviceState.SAFEOP),)
    assert not caplog.text
    assert kept("left").read() == replace(before, base=digest_of(changed(left)))


@pytest.mark.parametrize("data", [b"", b"{}", b"\0" * 100])
def test_damaged_file_is_put_aside(stations, caplog, data):
    left, _ = stations
    kept("left").save(configured(left))
    kept("left").path.write_bytes(data)
    assert effective("demo", (left,)) == (Effective(left, DeviceState.OP),)
    assert "cannot be used" in caplog.text
    assert str(kept("left").path) in caplog.text
    assert not kept("left").path.exists()
    assert kept("left").path.with_suffix(".damaged").read_bytes() == data
    kept("left").save(configured(left))
    assert effective("demo", (left,))[0].spec == changed(left)


def test_file_that_cannot_be_read_stays(stations, caplog):
    left, _ = stations
    kept("left").path.mkdir(parents=True)
    assert effective("demo", (left,)) == (Effective(left, DeviceState.OP),)
    assert "cannot be read" in caplog.text


def test_damaged_file_that_cannot_be_renamed_is_logged(stations, caplog):
    kept("left").save(configured(stations[0]))
    kept("left").path.write_bytes(b"?")
    (kept("left").path.with_suffix(".damaged") / "folder").mkdir(parents=True)
    assert kept("left").read() is None
    assert "cannot be renamed" in caplog.text


def test_failed_save_keeps_old_value(stations, monkeypatch, caplog):
    left, _ = stations
    kept("left").save(configured(left))

    def full(fd: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module.os, "fsync", full)
    with pytest.raises(EnvironmentalError, match=r"station left: .*No space left.*make room there"):
        kept("left").save(replace(configured(left), base="new"))
    assert [path.name for path in plant_folder("demo").iterdir()] == ["left.json"]
    assert kept("left").read() == configured(left)
    edited = changed(left, "edited")
    assert effective("demo", (edited,))[0].spec == edited
    assert "No space left" in caplog.text


def test_names_of_files_are_safe():
    folder = plant_folder("../plant")
    assert folder.parent == state_root()
    assert StationStore("../plant", "../../etc/passwd").configuration.path.parent == folder
    assert kept("a/b").path != kept("a_b").path


_WRITER = """
import sys
from msgspec.structs import replace
from eap.runtime.store import StationStore
file = StationStore("demo", "left").configuration
stored = file.decode(sys.stdin.buffer.read())
print("ready", flush=True)
for number in range(1_000_000):
    file.save(replace(stored, base=f"{number % 2}" * 64))
"""


@pytest.mark.net
def test_a_kill_at_any_moment_leaves_one_whole_file(stations, caplog):
    stored = configured(stations[0])
    kept("left").save(stored)
    for delay_s in (0.0, 0.003, 0.01, 0.02, 0.05):
        with subprocess.Popen(
            [sys.executable, "-c", _WRITER], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        ) as writer:
            assert writer.stdin
            assert writer.stdout
            writer.stdin.write(kept("left").path.read_bytes())
            writer.stdin.close()
            writer.stdout.readline()
            with pytest.raises(subprocess.TimeoutExpired):
                writer.wait(delay_s)
            writer.send_signal(signal.SIGKILL)
        found = kept("left").read()
        assert found is not None, caplog.text
        assert found.spec == stored.spec
    assert re.fullmatch(r"([01])\1{63}", found.base)


def test_a_configuration_is_set_aside_and_brought_back(stations):
    left, _ = stations
    assert not kept("left").set_aside()
    assert not kept("left").bring_back()
    kept("left").save(configured(left))
    assert kept("left").set_aside()
    assert kept("left").read() is None
    assert kept("left").bring_back()
    assert kept("left").read() == configured(left)
    assert kept("left").set_aside()
    newer = configured(left, state=DeviceState.PREOP)
    kept("left").save(newer)
    assert not kept("left").bring_back()
    assert kept("left").read() == newer


def test_folder_in_the_way_of_setting_aside(stations):
    kept("left").save(configured(stations[0]))
    (plant_folder("demo") / "left.before").mkdir()
    with pytest.raises(EnvironmentalError, match=r"left\.json cannot be renamed"):
        kept("left").set_aside()


def test_file_that_was_applied_is_not_edited_since(stations):
    left, _ = stations
    applied = changed(left, "new file")
    stored = replace(configured(left), applied=digest_of(applied))
    kept("left").save(stored)
    # While the appliance runs, its processes start with the file that it was started with.
    assert effective("demo", (left,))[0].spec == stored.spec
    assert kept("left").read() == stored
    # Its next start is with the file that was applied, though something else runs: a rollback.
    adopt_plant_file("demo", (applied,))
    assert effective("demo", (applied,))[0].spec == stored.spec
    assert kept("left").read() == replace(stored, base=digest_of(applied))


def moved(spec, phase_us: int = 250):
    return replace(spec, phase_us=spec.phase_us + phase_us)


def test_file_whose_phases_are_derived_in_another_way_is_not_edited(stations, caplog):
    left, _ = stations
    before = Configuration(base=digest_of(left), spec=left)
    kept("left").save(replace(configured(left), previous=before))
    assert effective("demo", (moved(left),))[0].spec == moved(changed(left))
    now = kept("left").read()
    assert now.previous == Configuration(base=digest_of(moved(left)), spec=moved(left))
    assert effective("demo", (moved(left),))[0].spec == now.spec
    assert not caplog.text


def test_file_that_was_applied_is_not_edited_by_another_phase(stations, caplog):
    left, _ = stations
    applied = changed(left, "new file")
    kept("left").save(replace(configured(left), applied=digest_of(applied)))
    adopt_plant_file("demo", (moved(applied),))
    assert effective("demo", (moved(applied),))[0].spec == moved(changed(left))
    assert kept("left").read().applied == digest_of(moved(applied))
    assert not caplog.text


def test_file_before_the_one_that_was_applied_is_an_edited_one(stations, caplog):
    left, _ = stations
    stored = replace(configured(left), applied=digest_of(changed(left)))
    kept("left").save(stored)
    adopt_plant_file("demo", (left,), DeviceState.PREOP)
    assert "the plant file was edited" in caplog.text
    assert effective("demo", (left,)) == (Effective(left, DeviceState.PREOP),)
    assert kept("left").read().previous.spec == changed(left)
    assert kept("left").read().applied == ""


def tolerant(spec):
    """The same, taking another layout as well."""
    alternate = RxAlternateSpec(9, (SentVariableSpec("ticks", "UINT"),))
    return replace(spec, subscriptions=(replace(spec.subscriptions[0], alternates=(alternate,)),))


def test_a_start_ends_a_change_that_was_broken_off(stations, caplog):
    _, right = stations
    file = changed(right, "new file")
    before = Configuration(base="", spec=right, objects={"eap0": 1})
    stored = Stored(base="", spec=tolerant(right), previous=before, cause="1")
    kept("right").save(stored)
    assert effective("demo", (file,)) == (Effective(file, DeviceState.OP),)
    assert "the plant file was edited" in caplog.text
    ended = kept("right").read()
    assert (ended.previous, ended.cause) == (before, "1")
    caplog.clear()
    kept("right").save(replace(stored, spec=tolerant(file)))
    assert effective("demo", (file,)) == (Effective(file, DeviceState.OP),)
    assert kept("right").read() == ended
    assert not caplog.text


def test_another_file_is_one_change_of_all_stations(stations):
    for spec in stations:
        kept(spec.name).save(replace(configured(spec), cause="0", undone=True))
    effective("demo", [changed(spec, "edited") for spec in stations])
    left, right = (kept(spec.name).read() for spec in stations)
    assert left.cause == right.cause > "0"
    assert not left.undone
    assert left.previous.spec == changed(stations[0])


def test_adopt_plant_file_without_stored_configuration(stations):
    left, right = stations
    adopt_plant_file("demo", stations)
    assert not state_root().exists()
    kept("left").save(configured(left))
    before = kept("left").path.stat()
    adopt_plant_file("demo", (changed(left, "edited"), right))
    after = kept("left").path.stat()
    assert (after.st_ino, after.st_mtime_ns) == (before.st_ino, before.st_mtime_ns)


@pytest.fixture
def stored(stations) -> Stored:
    left, right = stations
    before = Configuration(base="b0", spec=right, objects={"eap0": [1]})
    return Stored(
        base="b1",
        spec=left,
        objects={"eap0": {"1A00": "00"}},
        state=DeviceState.SAFEOP,
        previous=before,
    )


def test_stored_value_survives_its_file(stored):
    assert kept("left").decode(kept("left").encode(stored)) == stored


@pytest.mark.parametrize("cut", [0, 1, 10, 200, -1])
def test_cut_file_is_refused(stored, cut):
    with pytest.raises(ConfigError, match="not whole"):
        kept("left").decode(kept("left").encode(stored)[:cut])


def test_changed_octet_is_refused(stored):
    data = kept("left").encode(stored).replace(b"setpoint", b"setpaint")
    with pytest.raises(ConfigError, match="not what was written"):
        kept("left").decode(data)


def test_other_version_is_refused(stored):
    data = kept("left").encode(stored).replace(b'"version":1', b'"version":9')
    with pytest.raises(ConfigError, match=f"version is 9, this release knows {VERSION}"):
        kept("left").decode(data)


def test_content_that_is_no_configuration_is_refused():
    with pytest.raises(ConfigError, match="no configuration"):
        kept("left").decode(seal(b'{"base":1}', VERSION))


@pytest.mark.parametrize("data", [b"\xff\xfe", b"[]", b"null", b"{}"])
def test_anything_else_is_refused(data):
    with pytest.raises(ConfigError, match="not whole"):
        kept("left").decode(data)


def test_digest_of_distinguishes_specifications(stations):
    left, right = stations
    assert digest_of(left) == digest_of(replace(left))
    assert digest_of(left) != digest_of(right)
    assert digest_of(left) != digest_of(replace(left, cycle_us=20_000))
    counter, *_ = left.sources
    assert digest_of(left) != digest_of(replace(left, sources=(replace(counter, step=2),)))


def test_digest_does_not_depend_on_fields_that_hold_defaults():
    class Before(msgspec.Struct, frozen=True):
        name: str
        parts: tuple[msgspec.Struct, ...] = ()

    class After(msgspec.Struct, frozen=True):
        name: str
        parts: tuple[msgspec.Struct, ...] = ()
        added: int = 0

    assert digest_of(Before("a")) == digest_of(After("a"))  # type: ignore[arg-type]
    assert digest_of(Before("a")) != digest_of(After("a", added=1))  # type: ignore[arg-type]
    nested = Before("a", (Before("b"),)), Before("a", (After("b"),))
    assert digest_of(nested[0]) == digest_of(nested[1])  # type: ignore[arg-type]


@pytest.fixture
def file(tmp_path, monkeypatch):
    monkeypatch.setenv("EAP_STATE_DIR", str(tmp_path))
    return StationFile(plant_folder("a plant") / "notes", "left", list[int], "notes")


def test_a_value_comes_back_after_a_new_start(file):
    assert file.read() is None
    file.save([1, 2])
    assert StationFile(plant_folder("a plant") / "notes", "left", list[int], "notes").read() == [
        1,
        2,
    ]


@pytest.mark.parametrize(
    ("data", "reason"),
    [(b"x", "it is not whole"), (seal(b'["a"]', VERSION), "it holds no notes: Expected `int`")],
)
def test_a_damaged_file_is_put_aside(file, caplog, data, reason):
    file.save([1])
    file.path.write_bytes(data)
    assert file.read() is None
    assert f"station left: notes in {file.path} cannot be used: {reason}" in caplog.text
    assert file.path.with_suffix(".damaged").read_bytes() == data
    assert file.read() is None


def test_unreadable_or_unwritable_store_is_logged(file, caplog):
    file.path.mkdir(parents=True)
    assert file.read() is None
    assert "cannot be read (Is a directory)" in caplog.text
    with pytest.raises(EnvironmentalError, match=r"notes cannot be kept in .*; set EAP_STATE_DIR"):
        file.save([1])


def test_a_file_is_set_aside_and_brought_back(file):
    file.set_aside()
    file.bring_back()
    assert file.read() is None
    file.save([1])
    file.set_aside()
    assert file.read() is None
    file.bring_back()
    assert file.read() == [1]
    file.set_aside()
    file.save([2])
    file.bring_back()
    assert file.read() == [2]


ROUTES = (
    RouteSpec(
        name="plc", net_id="5.1.2.3.1.1", hop=HopSpec(TransportKind.AMS_TCP, "", "plc:48898")
    ),
)


@pytest.fixture
def store(tmp_path, monkeypatch):
    monkeypatch.setenv("EAP_STATE_DIR", str(tmp_path))
    return StationStore("demo", "left").routes


def test_routes_come_back(store, tmp_path):
    assert store.read() is None
    store.save(ROUTES)
    assert StationStore("demo", "left").routes.read() == ROUTES
    assert StationStore("demo", "right").routes.read() is None
    assert store.path == tmp_path / "demo/routes/left.json"
    store.save(())
    assert store.read() == ()


@pytest.mark.parametrize("data", [b"", b"[]", seal(b"[]", VERSION)[:-2], seal(b"[1]", VERSION)])
def test_damaged_routes_are_put_aside(store, caplog, data):
    store.save(ROUTES)
    store.path.write_bytes(data)
    assert store.read() is None
    assert "cannot be used" in caplog.text
    assert "left.damaged" in caplog.text
    assert not store.path.exists()


def test_routes_that_cannot_be_read_or_written_say_so(store, caplog):
    store.path.mkdir(parents=True)
    assert store.read() is None
    assert "cannot be read (Is a directory)" in caplog.text
    with pytest.raises(EnvironmentalError, match=r"routes cannot be kept in .*; set EAP_STATE_DIR"):
        store.save(ROUTES)


def test_applied_routing_is_stored_beside_added_routes(store, tmp_path):
    routing = StationStore("demo", "left").routing
    assert routing.read() is None
    applied = AppliedRouting(base="x", spec=RoutingSpec(routes=ROUTES), previous=RoutingSpec())
    routing.save(applied)
    assert StationStore("demo", "left").routing.read() == applied
    assert store.read() is None
    assert routing.path == tmp_path / "demo/routing/left.json"


def test_store_set_aside_and_bring_back(store):
    store.save(ROUTES)
    StationStore("demo", "left").set_aside()
    assert store.read() is None
    StationStore("demo", "left").bring_back()
    assert store.read() == ROUTES
    StationStore("demo", "left").set_aside()
    store.save(())
    StationStore("demo", "left").bring_back()
    assert store.read() == ()


def test_state_folder_of_the_version_before_is_taken_over(tmp_path, monkeypatch, caplog):
    """Written by a run of 22 November 2026 in which a plant file was applied and a route added."""
    shutil.copytree(VECTORS / "kept_state", tmp_path, dirs_exist_ok=True)
    monkeypatch.setenv("EAP_STATE_DIR", str(tmp_path))
    plant = load(tmp_path / "plant.yaml", lambda _path: ()).plant
    mill, saw = (each.spec for each in effective("kept", plant.stations))
    assert [each.name for each in mill.variables] == ["level", "turns", "speed"]
    assert mill.variables[0].default == 2.5
    assert saw.subscriptions[0].timeout_ms == 700
    for spec, before in zip((mill, saw), plant.stations, strict=True):
        kept = StationStore("kept", spec.name).configuration.read()
        assert kept.base == digest_of(before)
        assert kept.previous.spec == before
        dictionary = EapDictionary(spec, "eap0")
        fill_all({"eap0": dictionary}, kept.objects)
        assert read_back(spec, {"eap0": dictionary}) == spec
    assert [each.name for each in StationStore("kept", "mill").routes.read()] == ["plc"]
    routing = StationStore("kept", "saw").routing.read()
    assert routing.base == digest_of(plant.routing["saw"])
    assert routing.previous == plant.routing["saw"]
    assert routing.spec.access[0].networks == ("10.1.0.0/16",)
    assert not caplog.text


def test_lean_routing_keeps_fields_with_another_name_in_json():
    rule = AccessRule("local", services=(AccessService.WRITE,), transports=("ams-tcp",))
    spec = RoutingSpec(access=(rule,))
    plain = msgspec.to_builtins(lean(spec), enc_hook=encode_value)
    assert msgspec.convert(plain, RoutingSpec, dec_hook=decode_value) == spec


def test_lean_slave_configuration_keeps_the_kinds_of_its_writes():
    writes = SdoWrite(index=0x6060, data=b"\1"), IdnWrite(idn=0x8001, data=b"\2")
    spec = SlaveConfig(writes=writes)
    assert msgspec.convert(msgspec.to_builtins(lean(spec)), SlaveConfig) == spec
