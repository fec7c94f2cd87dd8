"""docs/one-connection.md: four foreign clients share one connection to a controller that drops."""

from __future__ import annotations

import ctypes
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.support.appliance import Appliance, Plants, plants, run_eapctl
from tests.support.eventually import wait_until
from tests.support.npm import NODE_MODULES, needs_npm, node_environment

pytest.importorskip("pyads", reason="needs pyads: pip install pyads")

pytestmark = [pytest.mark.net, pytest.mark.timeout(240)]

PAGE = (Path(__file__).parents[2] / "docs" / "one-connection.md").read_text()
EDGE_PLANT, HOME_ASSISTANT = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
(JAVASCRIPT,) = re.findall(r"```js\n(.*?)```", PAGE, re.DOTALL)
(FLOW,) = re.findall(r"```json\n(.*?)```", PAGE, re.DOTALL)
(PYTHON,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
CONTROLLER = """\
plant: press
defaults: {cycle_us: 10000}
stations:
  - name: press
    net_id: 127.9.75.2.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://127.9.75.2", net_id: 127.9.75.2.2.1}
    variables: {count: UDINT, setpoint: INT, limit: INT}
    sources: {count: {kind: counter}}
"""
LIMIT_S = 100.0
"""Node-RED loads its nodes for half a minute on a busy machine."""
# The pattern of Home Assistant's integration: notifications of the variable's size with the default
# attributes, found by their handles, values taken from the header's memory, no second subscription.
HUB = """
import ctypes, struct, sys, threading
import pyads
net_id, port, address, variable = sys.argv[1:]
client = pyads.Connection(net_id, int(port), address)
client.open()
items, lock = {}, threading.Lock()
def take(notification, name):
    contents = notification.contents
    start = ctypes.addressof(contents) + pyads.structs.SAdsNotificationHeader.data.offset
    data = (ctypes.c_ubyte * contents.cbSampleSize).from_address(start)
    with lock:
        item = items.get(int(contents.hNotification))
    if item is not None:
        print(struct.unpack("<I", bytearray(data))[0], flush=True)
attributes = pyads.NotificationAttrib(ctypes.sizeof(pyads.PLCTYPE_UDINT))
with lock:
    handle, user = client.add_device_notification(variable, attributes, take)
    items[int(handle)] = variable
threading.Event().wait()
"""


class Consumer:
    """A client process that gives numbers out, line by line."""

    def __init__(self, name: str, process: subprocess.Popen[bytes], out: Path, log: Path) -> None:
        self.name = name
        self.process = process
        self._out = out
        self._log = log

    def values(self) -> list[int]:
        assert self.process.poll() is None, f"{self.name}: {self._log.read_text()}"
        if not self._out.exists():
            return []
        return [int(line) for line in self._out.read_text().split("\n")[:-1]]


@pytest.fixture(scope="module")
def folder() -> Iterator[Plants]:
    with plants() as found:
        yield found


@pytest.fixture(scope="module")
def edge(folder: Plants) -> Appliance:
    return folder.run(folder.write(EDGE_PLANT, "edge.yaml"))


def start_press(folder: Plants) -> Appliance:
    return folder.run(folder.write(CONTROLLER, "press.yaml"))


def connections(plant: Appliance) -> int:
    """Return the number of AMS/TCP connections to a plant."""
    (listener,) = [each for each in plant.status()["listeners"] if "ams-tcp" in each["name"]]
    found: int = listener["open"]
    return found


def start_clients(folder: Path, stack: ExitStack) -> list[Consumer]:
    """Start the clients of the page."""
    red = folder / "node-red"
    red.mkdir()
    (red / "flow.json").write_text(FLOW)
    nodes = "node-red-contrib-ads-client"  # alone: to load all that are installed takes long
    (red / "node_modules").mkdir()
    (red / "node_modules" / nodes).symlink_to(NODE_MODULES / nodes)
    settings = {
        "uiPort": 0,
        "uiHost": "127.0.0.1",
        "flowFile": "flow.json",
        "httpAdminRoot": False,
        "httpNodeRoot": False,
        "telemetry": {"enabled": False},
        "credentialSecret": False,
        "externalModules": {"palette": {"denyList": ["node-red-contrib-opcua"]}},
    }
    (red / "settings.js").write_text(f"module.exports = {json.dumps(settings)};")
    keys = dict(re.findall(r"(\w+): ([\w.]+)", HOME_ASSISTANT))
    hub = [keys["device"], keys["port"], keys["ip_address"], keys["adsvar"]]
    wait = "\nimport threading\nthreading.Event().wait()\n"
    programs: dict[str, list[str]] = {
        "node-red": ["node", str(NODE_MODULES / "node-red" / "red.js"), "-u", str(red)],
        "ads-client": ["node", "-e", JAVASCRIPT],
        "pyads": [sys.executable, "-c", PYTHON + wait],
        "home-assistant": [sys.executable, "-c", HUB, *hub],
    }
    found = []
    for name, words in programs.items():
        out, log = folder / f"{name}.out", folder / f"{name}.log"
        environment = node_environment() | {"HOME": str(folder)}
        with out.open("wb") as stdout, log.open("wb") as stderr:
            process = subprocess.Popen(
                words, cwd=red if name == "node-red" else folder, env=environment,
                stdout=stdout, stderr=stderr,
            )  # fmt: skip
        stack.callback(process.wait, 20)
        stack.callback(process.kill)
        values = red / "values.txt" if name == "node-red" else out
        found.append(Consumer(name, process, values, out if name == "node-red" else log))
    return found


def without_figures(line: str) -> list[str]:
    """Return the first six words of a row: station, route, NetIDs, transport, address, state."""
    return line.split()[:6]


def wait_for_each(clients: list[Consumer], condition: Callable[[list[int]], object]) -> None:
    """Wait until *condition* holds for the values of each client."""
    waiting = {each.name: each for each in clients}

    def all_done() -> bool:
        for each in list(waiting.values()):
            if condition(each.values()):
                del waiting[each.name]
        return not waiting

    wait_until(all_done, LIMIT_S)


@needs_npm("node-red", "node-red-contrib-ads-client", "ads-client")
def test_four_clients_share_one_connection_and_outlive_the_controller(folder, edge, tmp_path):
    press = start_press(folder)
    # While the route waits for its next attempt, requests are answered with "host unreachable".
    route = ["routes", "test", "edge", "press"]
    wait_until(lambda: run_eapctl(edge.runtime, *route).returncode == 0)
    with ExitStack() as stack:
        clients = start_clients(tmp_path, stack)
        wait_for_each(clients, lambda values: len(values) > 3)
        for each in clients:
            values = each.values()
            assert values == sorted(values), each.name
        assert connections(edge) == len(clients)
        assert connections(press) == 1
        wait_until(lambda: press.values("press")["setpoint"] == 21)
        assert press.values("press")["limit"] == 90

        # Its services alone: the engine goes on counting.
        before = press.values("press")["count"]
        pid = press.pid("services")
        os.kill(pid, signal.SIGKILL)
        press.wait_for_another("services", pid)
        wait_for_each(clients, lambda values: values[-1] > before + 100)
        assert connections(press) == 1

        # The whole controller: it counts from zero again.
        press.close()
        press = start_press(folder)
        counts = {each.name: len(each.values()) for each in clients}
        wait_until(lambda: press.values("press")["count"] > 100)
        for each in clients:
            wait_until(lambda each=each: len(each.values()) > counts[each.name] + 3, 60)
            assert each.values()[-1] < before
        assert connections(edge) == len(clients)
        assert connections(press) == 1
    wait_until(lambda: "no errors" in edge.command("status"))
    (line,) = re.findall(r"^edge  .*$", PAGE, re.MULTILINE)
    shown = edge.command("routes", "list", "edge")
    assert without_figures(line) in [without_figures(each) for each in shown.splitlines()], shown


def test_flow_and_hub_name_the_types_of_the_page():
    assert ctypes.sizeof(__import__("pyads").PLCTYPE_UDINT) == 4
    assert "adstype: udint" in HOME_ASSISTANT
    assert {each["type"] for each in json.loads(FLOW)} >= {
        "ads-client-subscribe", "ads-client-write-symbol",
    }  # fmt: skip
