"""Configurations on disk: what runs after what, and what a kill or damage leaves."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from msgspec.structs import replace

from eap.appliance import store as module
from eap.appliance.configuration import Configuration, Stored, digest_of
from eap.appliance.store import Effective, Store, effective, settle, state_root
from eap.errors import EnvironmentalError
from eap.pd.device import DeviceState
from eap.pd.spec import RxAlternateSpec, TakenVariableSpec


def changed(spec, comment: str = "changed"):
    first, *others = spec.variables
    return replace(spec, variables=(replace(first, comment=comment), *others))


def configured(spec, *, state: DeviceState = DeviceState.OP) -> Stored:
    """What is stored of a station of the plant file after it was changed."""
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


def test_what_was_stored_runs(stations):
    left, right = stations
    store = Store("demo")
    store.save("left", configured(left, state=DeviceState.PREOP))
    assert store.load("left") == configured(left, state=DeviceState.PREOP)
    assert store.load("right") is None
    assert effective("demo", stations) == (
        Effective(changed(left), DeviceState.PREOP),
        Effective(right, DeviceState.OP),
    )
    assert effective("other", stations)[0].spec == left


def test_edited_plant_file_runs_and_the_rest_is_kept_for_a_rollback(stations, caplog):
    left, _ = stations
    store = Store("demo")
    store.save("left", configured(left, state=DeviceState.PREOP))
    edited = changed(left, "edited")
    assert effective("demo", (edited,)) == (Effective(edited, DeviceState.OP),)
    assert "station left: the plant file was edited" in caplog.text
    now = store.load("left")
    assert now is not None
    assert now.base == digest_of(edited)
    assert now.previous is not None
    assert (now.previous.spec, now.previous.objects) == (changed(left), {"eap0": 1})
    caplog.clear()
    assert effective("demo", (edited,)) == (Effective(edited, DeviceState.OP),)
    assert not caplog.text


def test_plant_file_that_caught_up_changes_nothing(stations, caplog):
    left, _ = stations
    store = Store("demo")
    before = configured(left, state=DeviceState.SAFEOP)
    store.save("left", before)
    assert effective("demo", (changed(left),)) == (Effective(changed(left), DeviceState.SAFEOP),)
    assert not caplog.text
    assert store.load("left") == replace(before, base=digest_of(changed(left)))


@pytest.mark.parametrize("data", [b"", b"{}", b"\0" * 100])
def test_damaged_file_is_put_aside(stations, caplog, data):
    left, _ = stations
    store = Store("demo")
    store.save("left", configured(left))
    store.file("left").write_bytes(data)
    assert effective("demo", (left,)) == (Effective(left, DeviceState.OP),)
    assert "cannot be used" in caplog.text
    assert str(store.file("left")) in caplog.text
    assert not store.file("left").exists()
    assert store.file("left").with_suffix(".damaged").read_bytes() == data
    store.save("left", configured(left))
    assert effective("demo", (left,))[0].spec == changed(left)


def test_file_that_cannot_be_read_stays(stations, caplog):
    left, _ = stations
    store = Store("demo")
    store.file("left").mkdir(parents=True)
    assert effective("demo", (left,)) == (Effective(left, DeviceState.OP),)
    assert "cannot be read" in caplog.text


def test_damaged_file_that_cannot_be_renamed_is_told(stations, caplog):
    store = Store("demo")
    store.save("left", configured(stations[0]))
    store.file("left").write_bytes(b"?")
    (store.file("left").with_suffix(".damaged") / "folder").mkdir(parents=True)
    assert store.load("left") is None
    assert "cannot be renamed" in caplog.text


def test_refused_write_keeps_what_there_was(stations, monkeypatch, caplog):
    left, _ = stations
    store = Store("demo")
    store.save("left", configured(left))

    def full(fd: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module.os, "fsync", full)
    with pytest.raises(EnvironmentalError, match=r"station left: .*No space left.*make room there"):
        store.save("left", replace(configured(left), base="new"))
    assert [path.name for path in store.path.iterdir()] == ["left.json"]
    assert store.load("left") == configured(left)
    edited = changed(left, "edited")
    assert effective("demo", (edited,))[0].spec == edited
    assert "No space left" in caplog.text


def test_names_of_files_are_safe():
    store = Store("../plant")
    assert store.path.parent == state_root()
    assert store.file("../../etc/passwd").parent == store.path
    assert store.file("a/b") != store.file("a_b")


_WRITER = """
import sys
from msgspec.structs import replace
from eap.appliance.configuration import decode_stored
from eap.appliance.store import Store
store = Store("demo")
stored = decode_stored(sys.stdin.buffer.read())
print("ready", flush=True)
for number in range(1_000_000):
    store.save("left", replace(stored, base=f"{number % 2}" * 64))
"""


@pytest.mark.net
def test_a_kill_at_any_moment_leaves_one_whole_file(stations, caplog):
    store = Store("demo")
    stored = configured(stations[0])
    store.save("left", stored)
    for delay_s in (0.0, 0.003, 0.01, 0.02, 0.05):
        with subprocess.Popen(
            [sys.executable, "-c", _WRITER], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        ) as writer:
            assert writer.stdin
            assert writer.stdout
            writer.stdin.write(store.file("left").read_bytes())
            writer.stdin.close()
            writer.stdout.readline()
            with pytest.raises(subprocess.TimeoutExpired):
                writer.wait(delay_s)
            writer.send_signal(signal.SIGKILL)
        found = store.load("left")
        assert found is not None, caplog.text
        assert found.spec == stored.spec
    assert re.fullmatch(r"([01])\1{63}", found.base)


def test_a_configuration_is_set_aside_and_brought_back(stations):
    left, _ = stations
    store = Store("demo")
    assert not store.set_aside("left")
    assert not store.bring_back("left")
    store.save("left", configured(left))
    assert store.set_aside("left")
    assert store.load("left") is None
    assert store.bring_back("left")
    assert store.load("left") == configured(left)
    assert store.set_aside("left")
    newer = configured(left, state=DeviceState.PREOP)
    store.save("left", newer)
    assert not store.bring_back("left")
    assert store.load("left") == newer


def test_folder_in_the_way_of_setting_aside(stations):
    store = Store("demo")
    store.save("left", configured(stations[0]))
    (store.path / "left.before").mkdir()
    with pytest.raises(EnvironmentalError, match=r"left\.json cannot be renamed"):
        store.set_aside("left")


def test_file_that_was_applied_is_not_edited_since(stations):
    left, _ = stations
    store = Store("demo")
    applied = changed(left, "new file")
    stored = replace(configured(left), applied=digest_of(applied))
    store.save("left", stored)
    # While the appliance runs, its processes start with the file that it was started with.
    assert effective("demo", (left,))[0].spec == stored.spec
    assert store.load("left") == stored
    # Its next start is with the file that was applied, though something else runs: a rollback.
    settle("demo", (applied,))
    assert effective("demo", (applied,))[0].spec == stored.spec
    assert store.load("left") == replace(stored, base=digest_of(applied))


def test_file_before_the_one_that_was_applied_is_an_edited_one(stations, caplog):
    left, _ = stations
    store = Store("demo")
    stored = replace(configured(left), applied=digest_of(changed(left)))
    store.save("left", stored)
    settle("demo", (left,), DeviceState.PREOP)
    assert "the plant file was edited" in caplog.text
    assert effective("demo", (left,)) == (Effective(left, DeviceState.PREOP),)
    assert store.load("left").previous.spec == changed(left)
    assert store.load("left").applied == ""


def tolerant(spec):
    """The same, taking another layout as well."""
    alternate = RxAlternateSpec(9, (TakenVariableSpec("ticks", "UINT"),))
    return replace(spec, subscriptions=(replace(spec.subscriptions[0], alternates=(alternate,)),))


def test_a_start_ends_a_change_that_was_broken_off(stations, caplog):
    _, right = stations
    store = Store("demo")
    file = changed(right, "new file")
    before = Configuration(base="", spec=right, objects={"eap0": 1})
    stored = Stored(base="", spec=tolerant(right), previous=before, cause="1")
    store.save("right", stored)
    assert effective("demo", (file,)) == (Effective(file, DeviceState.OP),)
    assert "the plant file was edited" in caplog.text
    ended = store.load("right")
    assert (ended.previous, ended.cause) == (before, "1")
    caplog.clear()
    store.save("right", replace(stored, spec=tolerant(file)))
    assert effective("demo", (file,)) == (Effective(file, DeviceState.OP),)
    assert store.load("right") == ended
    assert not caplog.text


def test_another_file_is_one_change_of_all_stations(stations):
    store = Store("demo")
    for spec in stations:
        store.save(spec.name, replace(configured(spec), cause="0", undone=True))
    effective("demo", [changed(spec, "edited") for spec in stations])
    left, right = (store.load(spec.name) for spec in stations)
    assert left.cause == right.cause > "0"
    assert not left.undone
    assert left.previous.spec == changed(stations[0])


def test_nothing_to_settle(stations):
    left, right = stations
    settle("demo", stations)
    assert not state_root().exists()
    Store("demo").save("left", configured(left))
    before = Store("demo").file("left").stat()
    settle("demo", (changed(left, "edited"), right))
    assert Store("demo").file("left").stat() == before
