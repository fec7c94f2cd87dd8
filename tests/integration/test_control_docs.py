"""docs/control.md: its plant runs, and its exchanges give the printed answers."""

from __future__ import annotations

import json
import re
import shutil
import socket
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import pytest

from eap.ops.client import connect
from tests.support.appliance import start_eapctl, wait_until

pytestmark = pytest.mark.net

PAGE = (Path(__file__).parents[2] / "docs" / "control.md").read_text()
PLANT, OVEN = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
LINES = [
    line
    for block in re.findall(r"```text\n(.*?)```", PAGE, re.DOTALL)
    for line in block.splitlines()
]
OF_THIS_MACHINE = {"realtime", "release", "version", "interface", "file", "plant_file", "compiled"}


def outline(value: Any) -> Any:
    """Reduce an answer to what is the same on every machine and in every run."""
    if isinstance(value, dict):
        return {
            key: "..." if key in OF_THIS_MACHINE else outline(item) for key, item in value.items()
        }
    if isinstance(value, list):
        return [outline(item) for item in value]
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return "a number"
    return value


@pytest.fixture
def control(monkeypatch):
    folder = Path(tempfile.mkdtemp(prefix="eap-"))  # short enough for a socket's path
    monkeypatch.setenv("EAP_RUNTIME_DIR", str(folder))
    (folder / "kiln.yaml").write_text(PLANT)
    (folder / "oven.yaml").write_text(OVEN)
    process = start_eapctl("run", str(folder / "kiln.yaml"), stdout=subprocess.PIPE)
    try:
        assert process.stdout is not None
        assert process.stdout.readline()
        yield folder / "kiln" / "control", process
    finally:
        process.kill()
        process.communicate()
        shutil.rmtree(folder)


def wait_for_data() -> None:
    (client,) = connect()
    with client:
        client.request("bus_describe", station="burner", port="bus0", wait=True)
        wait_until(lambda: client.request("read", station="panel")["values"]["flame"] >= 10)


def test_control_page_exchanges_match(control):
    path, process = control
    wait_for_data()
    with socket.socket(socket.AF_UNIX) as connection:
        connection.settimeout(20)
        connection.connect(str(path))
        reader = connection.makefile("rb")
        for line in LINES:
            if line.startswith("> "):
                connection.sendall(line[2:].encode() + b"\n")
            else:
                told = outline(json.loads(line.removeprefix("< ")))
                assert outline(json.loads(reader.readline())) == told, line
        reader.close()
    assert len(LINES) > 30
    assert process.wait(40) == 0  # the last exchange of the page stops it
