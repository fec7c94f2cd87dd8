"""Variables of running stations by ADS, with pyads: by name, in lists, told when they change."""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from eap.codec.ads import AdsError, AdsState
from tests.support import aoe
from tests.support.adslib import open_connection
from tests.support.amsclient import AmsClient
from tests.support.appliance import Appliance, Plants, run_eapctl, wait_until
from tests.support.machine import slowness

pyads = pytest.importorskip("pyads", reason="needs pyads: pip install pyads")

pytestmark = pytest.mark.net

BUSES = Path(__file__).parents[2] / "config" / "buses"
ADDRESS = "127.9.73.1"
ROUTER, PORT, BUS = (f"{ADDRESS}.{end}" for end in ("1.1", "2.1", "3.1"))
DEVICE, SYSTEM, IO, SDO = 0xFFFF, 10_000, 300, 0xF302
PLANT = f"""\
plant: variables
defaults: {{cycle_us: 2000}}
stations:
  - name: tower
    net_id: {ROUTER}
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{ADDRESS}", net_id: {PORT}}}
      - {{name: bus0, kind: bus, interface: "sim://{BUSES}/drive.yaml", net_id: {BUS}}}
    variables:
      level: {{type: UDINT, default: 4711, unit: mm, comment: of the tank}}
      ticks: {{type: UDINT}}
      curve: {{type: "INT[4]"}}
      label: {{type: STRING(15), default: pump}}
      open: {{type: BOOL}}
      recipe: {{type: BLOCK(1000)}}
    sources:
      ticks: {{kind: counter}}
    frames:
      - {{name: out, port: eap0, to: 127.9.73.9}}
    publish:
      - {{name: state, frame: out, id: 77, variables: [level, ticks, curve, label, open]}}
"""


@pytest.fixture(scope="module")
def appliance(module_farm: Plants) -> Appliance:
    return module_farm.run(module_farm.write(PLANT))


@pytest.fixture(scope="module")
def tower(appliance: Appliance) -> pyads.Connection:
    del appliance
    return open_connection(PORT, DEVICE, ADDRESS)


_CALLED_LATE: list[object] = []


class Told:
    """The notifications of one connection, taken back at the end: AdsLib crashes otherwise."""

    def __init__(self, connection: pyads.Connection) -> None:
        self.connection = connection
        self._handles: list[tuple[int, int]] = []

    def of(self, name: str, kind: type, **attributes: object) -> list[tuple[float, object]]:
        """Return the list to which each notification adds time stamp and value."""
        told: list[tuple[float, object]] = []

        def take(notification: object, _: object) -> None:
            _, stamp, value = self.connection.parse_notification(notification, kind)
            told.append((stamp.timestamp(), value))

        wanted = pyads.NotificationAttrib(ctypes.sizeof(kind), **attributes)
        self._handles.append(self.connection.add_device_notification(name, wanted, take))
        return told

    def end(self) -> None:
        # AdsLib may call back after pyads has dropped the function of a deleted notification.
        _CALLED_LATE.extend(pyads.pyads_ex.callback_store.values())
        for handles in self._handles:
            self.connection.del_device_notification(*handles)


@pytest.fixture
def told(tower: pyads.Connection) -> Iterator[Told]:
    told = Told(tower)
    yield told
    told.end()


CYCLIC = {"trans_mode": pyads.ADSTRANS_SERVERCYCLE, "max_delay": 0}


def refusal(attempt: Callable[[], object]) -> int:
    with pytest.raises(pyads.ADSError) as refused:
        attempt()
    return int(refused.value.err_code)


def test_variables_are_read_and_written_by_name(appliance, tower) -> None:
    assert tower.read_by_name("level") == 4711
    assert tower.read_by_name("label") == "pump"
    wanted = {"level": 12, "curve": [1, -2, 3, -4], "label": "fan", "open": True}
    for name, value in wanted.items():
        tower.write_by_name(name, value)
    assert tower.read_list_by_name(list(wanted)) == wanted
    values = appliance.values("tower")
    assert {name: values[name] for name in wanted} == wanted
    assert tower.get_symbol("level").read() == 12


def test_each_symbol_has_type_and_comment(tower) -> None:
    symbols = {symbol.name: symbol for symbol in tower.get_all_symbols()}
    assert (symbols["level"].symbol_type, symbols["level"].comment) == ("UDINT", "of the tank [mm]")
    assert symbols["curve"].symbol_type == "ARRAY [0..3] OF INT"
    assert {"bus0.state", "out.FrameCtrl", "state.VarCtrl"} <= set(symbols)
    drive = [name for name in symbols if name.startswith("bus0.") and name.count(".") == 2]
    assert drive
    assert tower.read_list_by_name(drive).keys() == set(drive)
    wait_until(lambda: symbols["bus0.state"].read() == 8)


def test_only_variables_of_the_application_are_written(appliance, tower) -> None:
    assert refusal(lambda: tower.write_by_name("ticks", 1)) == AdsError.ACCESS
    results = tower.write_list_by_name({"level": 5, "bus0.state": 1, "open": False})
    denied = pyads.errorcodes.ERROR_CODES[AdsError.ACCESS]
    assert list(results.values()) == ["no error", denied, "no error"]
    assert refusal(lambda: tower.read_by_name("levle")) == AdsError.SYMBOL_NOT_FOUND
    other = "import eap; s = eap.attach('tower'); s['level'] = 9; print(s['level']); input()"
    environment = os.environ | {"EAP_RUNTIME_DIR": str(appliance.runtime)}
    with subprocess.Popen(
        [sys.executable, "-c", other], stdin=-1, stdout=-1, env=environment, text=True
    ) as program:
        assert program.stdout.readline() == "9\n"
        assert refusal(lambda: tower.write_by_name("level", 1)) == AdsError.BUSY
        assert tower.read_by_name("level") == 9
        program.communicate("\n")
    tower.write_by_name("level", 1)


def test_every_cycle_is_notified_with_its_own_time(appliance, told) -> None:
    skipped = appliance.station("tower")["overruns"]
    ticks = told.of("ticks", pyads.PLCTYPE_UDINT, cycle_time=0, **CYCLIC)
    wait_until(lambda: len(ticks) > 400)
    values = [value for _, value in ticks]
    assert values == sorted(set(values))
    # The counter goes on in cycles that the engine had to skip on a busy machine.
    missing = values[-1] - values[0] + 1 - len(values)
    assert missing <= appliance.station("tower")["overruns"] - skipped
    distances = sorted(b - a for (a, _), (b, _) in pairwise(ticks))
    assert distances[len(distances) // 2] == pytest.approx(0.002, abs=0.0005)
    assert time.time() - ticks[-1][0] < 5


def test_changes_and_longer_cycle_times_are_notified(tower, told) -> None:
    tower.write_by_name("level", 100)
    changes = told.of("level", pyads.PLCTYPE_UDINT)
    slow = told.of("ticks", pyads.PLCTYPE_UDINT, cycle_time=100, **CYCLIC)
    bundled = told.of("ticks", pyads.PLCTYPE_UDINT, cycle_time=2, max_delay=100, trans_mode=3)
    wait_until(lambda: changes and len(slow) > 5)
    tower.write_by_name("level", 101)
    wait_until(lambda: len(changes) == 2)
    assert [value for _, value in changes] == [100, 101]
    distances = [b - a for (a, _), (b, _) in pairwise(slow)]
    assert sum(distances) / len(distances) == pytest.approx(0.1, rel=0.1)
    assert len(bundled) > 100


def test_notifications_are_asked_for_by_sums_too(appliance) -> None:
    del appliance
    with AmsClient(ADDRESS) as client:
        watched = struct.pack("<6I16x", 0xF100, 0, 4, 4, 0, 0)
        body = struct.pack("<4I", 0xF085, 2, 16, 80) + watched * 2
        error, data = client.ask(PORT, 9, body)
        results = struct.unpack("<4I", data[8:])
        assert (error, results[0], results[2]) == (0, 0, 0)
        handles = struct.pack("<2I", results[1], results[3])
        error, data = client.ask(PORT, 9, struct.pack("<4I", 0xF086, 2, 8, 8) + handles)
        assert (error, data[8:]) == (0, bytes(8))


def test_notifications_outlive_the_engine(appliance, told) -> None:
    ticks = told.of("ticks", pyads.PLCTYPE_UDINT, cycle_time=0, **CYCLIC)
    wait_until(lambda: len(ticks) > 10)
    os.kill(appliance.pid("engine"), signal.SIGKILL)
    killed = time.time()
    wait_until(lambda: ticks[-1][0] > killed + 1.0, timeout_s=20)
    values = [value for _, value in ticks]
    assert values == sorted(set(values))


def test_notifications_outlive_another_layout(appliance, tower, told, tmp_path) -> None:
    ticks = told.of("ticks", pyads.PLCTYPE_UDINT, cycle_time=0, **CYCLIC)
    before = tower.read(0xF008, 0, pyads.PLCTYPE_BYTE)
    wait_until(lambda: len(ticks) > 10)
    more = PLANT.replace(
        "      open: {type: BOOL}\n", "      open: {type: BOOL}\n      more: {type: INT}\n"
    )
    changed = tmp_path / "changed.yaml"
    changed.write_text(more)
    done = run_eapctl(appliance.runtime, "apply", str(changed))
    assert done.returncode == 0, done.stdout + done.stderr
    applied = time.time()
    wait_until(lambda: ticks[-1][0] > applied + 0.2)
    assert tower.read(0xF008, 0, pyads.PLCTYPE_BYTE) == before + 1
    assert tower.read_by_name("more") == 0
    assert run_eapctl(appliance.runtime, "rollback", str(changed)).returncode == 0


DIES = """
import os, sys, pyads
plc = pyads.Connection(sys.argv[1], 0xFFFF, sys.argv[2])
plc.open()
plc.add_device_notification("ticks", pyads.NotificationAttrib(4), lambda *_: os._exit(0))
import time; time.sleep(20)
sys.exit("was told nothing")
"""


def test_client_that_dies_or_stops_reading_leaves_others_alone(appliance, told) -> None:
    ticks = told.of("ticks", pyads.PLCTYPE_UDINT, cycle_time=0, **CYCLIC)
    subprocess.run([sys.executable, "-c", DIES, PORT, ADDRESS], timeout=30, check=True)
    small = socket.socket()
    small.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    with AmsClient(ADDRESS, small) as client:
        error, handle = client.ask(PORT, 9, struct.pack("<4I", 0xF003, 0, 4, 6) + b"recipe")
        assert not error
        watched = struct.pack("<I4sI", 0xF005, handle[8:], 1000) + struct.pack("<3I16x", 3, 0, 0)
        for _ in range(50):
            client.send(aoe.packet(PORT, 6, watched))  # and takes nothing
        wait_until(lambda: appliance.station("tower")["discarded"].get("ams_slow"))
    values = [value for _, value in ticks]
    assert values == sorted(set(values))
    assert share(values) > 0.9 / slowness()  # fifty variables more are work, too
    wait_until(lambda: len(ticks) > len(values) + 500)
    wait_until(lambda: share([value for _, value in ticks[-500:]]) > 0.9)


def share(values: list[int]) -> float:
    """Return how much of a count was told."""
    return len(values) / (values[-1] - values[0] + 1)


def test_states_are_requested_at_ports_and_router(appliance, tower) -> None:
    with pyads.Connection(ROUTER, SYSTEM, ADDRESS) as system:
        assert system.read_device_info()[0] == "tower"
        assert system.read_state() == (AdsState.RUN, 8)
        system.write_control(AdsState.CONFIG, 0, 0, pyads.PLCTYPE_INT)
        assert tower.read_state() == (AdsState.CONFIG, 2)
        assert appliance.station("tower")["state"] == "PREOP"
        tower.write_control(AdsState.RUN, 0, 0, pyads.PLCTYPE_INT)
        assert system.read_state() == (AdsState.RUN, 8)
        refused = refusal(lambda: tower.write_control(AdsState.INIT, 0, 0, pyads.PLCTYPE_INT))
        assert refused == AdsError.STATE


def test_router_lists_the_ports_and_has_a_dictionary(appliance) -> None:
    with pyads.Connection(ROUTER, IO, ADDRESS) as server:
        assert server.read(0x5000, 1, ctypes.c_uint16 * 3) == [2, 1, 2]
        assert server.read(0x5002, 1, pyads.PLCTYPE_STRING) == "bus0"
        assert server.read(0x5002, 5, ctypes.c_uint8 * 6) == list(aoe.net_id(BUS))
        assert server.read(0x5002, 7, pyads.PLCTYPE_UINT) == 111
    with pyads.Connection(ROUTER, DEVICE, ADDRESS) as router:
        assert router.read(SDO, 0x10000000, pyads.PLCTYPE_UDINT) == 9000 << 16 | 5001
        assert router.read(SDO, 0x80010001, ctypes.c_uint8 * 6) == list(aoe.net_id(BUS))
        assert router.read(SDO, 0x80000006, pyads.PLCTYPE_UINT) == 8
        assert refusal(lambda: router.write(SDO, 0xF0000001, 1, pyads.PLCTYPE_UINT)) == 0x704
    listed = appliance.command("od", "list", "tower/router")
    assert "AoE device 1" in listed
    assert "bus0" in listed
    shown = appliance.command("od", "read", "tower/router", "0x8000:3")
    assert f"udp://{ADDRESS}" in shown
