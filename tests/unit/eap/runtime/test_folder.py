"""The runtime directory: claims, refusals, dead folders."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from eap.errors import EnvironmentalError
from eap.runtime import folder as runtime
from eap.runtime.folder import (
    ApplianceFolder,
    ApplianceInfo,
    find_appliances,
    find_running,
    folder_name,
)


@pytest.fixture(autouse=True)
def root(tmp_path, monkeypatch):
    monkeypatch.setenv("EAP_RUNTIME_DIR", str(tmp_path / "eap"))
    return tmp_path / "eap"


def info(plant: str = "demo") -> ApplianceInfo:
    return ApplianceInfo(plant, "demo.yaml", ["a"], "2026-01-01T00:00:00+00:00", os.getpid())


@pytest.fixture
def no_session(tmp_path, monkeypatch):
    """Neither EAP_RUNTIME_DIR nor a session directory, and a /run/eap that cannot be made."""
    monkeypatch.delenv("EAP_RUNTIME_DIR")
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.setattr(runtime, "SYSTEM_ROOT", tmp_path / "absent" / "eap")
    monkeypatch.setattr(runtime, "FALLBACK_PARENT", tmp_path)
    return tmp_path / f"eap-{os.geteuid()}"


def test_runtime_root_is_the_first_that_can_be_written(tmp_path, no_session, monkeypatch):
    assert runtime.runtime_root() == no_session
    system = tmp_path / "run" / "eap"
    system.mkdir(parents=True)
    monkeypatch.setattr(runtime, "SYSTEM_ROOT", system)
    assert runtime.runtime_root() == system
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "absent"))
    assert runtime.runtime_root() == system
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert runtime.runtime_root() == tmp_path / "eap"
    monkeypatch.setenv("EAP_RUNTIME_DIR", "/x")
    assert runtime.runtime_root() == Path("/x")


def test_claim_without_a_session_directory_makes_a_private_folder(no_session, caplog):
    with ApplianceFolder.claim("demo") as folder:
        assert folder.path == no_session / "demo"
        assert stat.S_IMODE(no_session.stat().st_mode) == 0o700
        folder.write_info(info())
        assert [found.plant for _, found in find_running()] == ["demo"]
    (line,) = caplog.messages
    assert line.startswith(f"runtime directory is {no_session}: there is no session directory")


def test_find_running_looks_in_every_directory(tmp_path, no_session, monkeypatch):
    with ApplianceFolder.claim("of-cron") as first:
        first.write_info(info("of-cron"))
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))  # as a client in a session has it
        with ApplianceFolder.claim("of-session") as second:
            second.write_info(info("of-session"))
            assert [found.plant for _, found in find_running()] == ["of-cron", "of-session"]


def test_claim_refuses_a_private_folder_that_is_a_link(tmp_path, no_session):
    (tmp_path / "target").mkdir()
    no_session.symlink_to(tmp_path / "target")
    with pytest.raises(EnvironmentalError, match="it is a symbolic link; remove it, or set EAP_"):
        ApplianceFolder.claim("demo")
    assert list((tmp_path / "target").iterdir()) == []


def test_claim_refuses_a_private_folder_that_is_a_file(no_session):
    no_session.write_text("")
    with pytest.raises(EnvironmentalError, match="it is no directory"):
        ApplianceFolder.claim("demo")


def test_claim_refuses_a_private_folder_that_others_may_enter(no_session):
    no_session.mkdir()
    no_session.chmod(0o770)
    with pytest.raises(EnvironmentalError, match=r"other users have rights in it \(mode 070\)"):
        ApplianceFolder.claim("demo")


@pytest.mark.host_root
def test_claim_refuses_a_private_folder_of_another_user(no_session):
    no_session.mkdir(mode=0o700)
    os.chown(no_session, 65534, 65534)
    with pytest.raises(EnvironmentalError, match="it belongs to user nobody"):
        ApplianceFolder.claim("demo")
    assert find_appliances() == []


def test_folder_names_are_readable_and_unique():
    assert folder_name("demo") == "demo"
    assert folder_name("demo", ["a", "b"]) == "demo@a+b"
    assert "/" not in folder_name("a/b")
    assert folder_name("a/b") != folder_name("a_b")
    assert folder_name("..") not in {"..", "."}
    long = [f"station-{n}" for n in range(40)]
    assert len(folder_name("demo", long)) < 80
    assert folder_name("demo", long) != folder_name("demo", long[:-1])


def test_claim_refuses_a_second_start_and_names_the_holder():
    with ApplianceFolder.claim("demo"), pytest.raises(EnvironmentalError, match=str(os.getpid())):
        ApplianceFolder.claim("demo")
    with ApplianceFolder.claim("demo"):
        pass


def test_find_sees_only_the_living(root):
    assert find_appliances() == []
    dead = root / "dead"
    dead.mkdir(parents=True)
    (dead / "lock").write_text("1")
    (dead / "appliance.json").write_text("{}")
    (root / "no-lock").mkdir()
    with ApplianceFolder.claim("demo") as folder:
        folder.write_info(info())
        assert [found.path.name for found in find_appliances()] == ["demo"]
        assert find_appliances()[0].read_info() == info()
        with pytest.raises(EnvironmentalError):  # asking took nothing away
            ApplianceFolder.claim("demo")
    assert find_appliances() == []
    assert not (root / "demo").exists()


def test_a_killed_holder_leaves_a_folder_that_is_emptied_and_reused(root):
    code = (
        "import os, signal\n"
        "from eap.runtime.folder import ApplianceFolder\n"
        "folder = ApplianceFolder.claim('demo')\n"
        "folder.image('a').write_bytes(b'old')\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], check=False)
    assert done.returncode == -9
    assert (root / "demo" / "a.image").exists()
    assert find_appliances() == []
    with ApplianceFolder.claim("demo") as folder:
        assert not folder.image("a").exists()


def test_a_directory_that_cannot_be_made_names_the_variable(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("EAP_RUNTIME_DIR", str(tmp_path / "file" / "eap"))
    with pytest.raises(EnvironmentalError, match="EAP_RUNTIME_DIR"):
        ApplianceFolder.claim("demo")
    assert find_appliances() == []


def test_claim_does_not_empty_foreign_directory(root):
    (root / "demo").mkdir(parents=True)
    (root / "demo" / "thesis.txt").write_text("")
    with pytest.raises(EnvironmentalError, match="no folder of an appliance"):
        ApplianceFolder.claim("demo")
    assert [entry.name for entry in (root / "demo").iterdir()] == ["thesis.txt"]


def test_find_running_skips_unreadable_folders(root):
    with ApplianceFolder.claim("demo") as folder, ApplianceFolder.claim("starting") as starting:
        folder.write_info(info())
        assert [found.plant for _, found in find_running()] == ["demo"]
        (starting.path / "appliance.json").write_text("of another release")
        assert [found.plant for _, found in find_running()] == ["demo"]


def test_a_path_too_long_for_a_socket_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("EAP_RUNTIME_DIR", str(tmp_path / ("x" * 100)))
    with pytest.raises(EnvironmentalError, match="107"):
        ApplianceFolder.claim("demo")


def test_closing_twice_is_harmless_and_keeps_a_successor():
    first = ApplianceFolder.claim("demo")
    first.close()
    with ApplianceFolder.claim("demo") as second:
        first.close()
        assert second.is_alive()
