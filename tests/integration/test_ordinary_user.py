"""An ordinary user without a session directory: a private folder in /tmp, and clients find it."""

from __future__ import annotations

import json
import os
import shutil
import signal
import stat
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.appliance import EAPCTL

pytestmark = [pytest.mark.net, pytest.mark.host_root]

UID = 64_951
PRIVATE = Path(f"/tmp/eap-{UID}")
BLANK = ["--blank", "only", "--interface", "udp://127.9.97.1", "--net-id", "127.9.97.1.2.1"]
# Reading this tree is all that is kept of root: a capability to write would find /run/eap usable.
AS_USER = ["setpriv", f"--reuid={UID}", f"--regid={UID}", "--clear-groups"]
AS_USER += ["--inh-caps=+dac_read_search", "--ambient-caps=+dac_read_search"]


@pytest.fixture
def environment() -> Iterator[dict[str, str]]:
    shutil.rmtree(PRIVATE, ignore_errors=True)
    removed = {"EAP_RUNTIME_DIR", "XDG_RUNTIME_DIR"}
    kept = {name: value for name, value in os.environ.items() if name not in removed}
    yield kept | {"EAP_STATE_DIR": f"{PRIVATE}-state"}
    shutil.rmtree(PRIVATE, ignore_errors=True)


def start(environment: dict[str, str]) -> subprocess.Popen[str]:
    command = [*AS_USER, *EAPCTL, "run", *BLANK, "--no-realtime"]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, env=environment, stdout=pipe, stderr=pipe, text=True)


def test_appliance_without_session_directory_runs_in_a_private_folder(
    environment: dict[str, str],
) -> None:
    with start(environment) as appliance:
        try:
            assert appliance.stdout is not None
            assert json.loads(appliance.stdout.readline())["ready"] is True
            found = PRIVATE.stat()
            assert (found.st_uid, stat.S_IMODE(found.st_mode)) == (UID, 0o700)
            status = subprocess.run(
                [*AS_USER, *EAPCTL, "status", "--json"],
                env=environment, capture_output=True, text=True, check=True,
            )  # fmt: skip
            assert [each["name"] for each in json.loads(status.stdout)["stations"]] == ["only"]
        finally:
            appliance.send_signal(signal.SIGTERM)
            _, errors = appliance.communicate(timeout=20)
        assert appliance.returncode == 0
        assert errors.startswith(f"supervisor: runtime directory is {PRIVATE}: there is no session")


def test_appliance_refuses_a_private_folder_that_another_user_made(
    environment: dict[str, str],
) -> None:
    PRIVATE.mkdir(mode=0o777)
    with start(environment) as appliance:
        out, errors = appliance.communicate(timeout=20)
    assert (appliance.returncode, out) == (2, "")
    assert f"runtime directory {PRIVATE} cannot be used: it belongs to user root" in errors
    assert len(errors.splitlines()) == 1
    assert list(PRIVATE.iterdir()) == []
