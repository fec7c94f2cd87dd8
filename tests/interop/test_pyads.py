"""pyads, and AdsLib inside it, as the client of our ADS services."""

from __future__ import annotations

import ctypes
import datetime as dt
import subprocess
import sys
import time

import pytest

from eap.codec.ads import AdsError, AdsState, IndexGroup
from eap.codec.adsnotification import TransMode
from eap.codec.adssymbol import AdsType, SymbolFlag
from tests.support.addresses import own_address
from tests.support.adsdevice import (
    BUS_NET_ID,
    VALUES,
    DictStore,
    FakeMaster,
    Station,
    io_device,
    master_device,
    system_device,
    variable_device,
)
from tests.support.amstcp import AmsTcpServer
from tests.support.appliance import wait_until

pyads = pytest.importorskip("pyads", reason="needs pyads: pip install pyads")

pytestmark = pytest.mark.net

NET_ID = "5.23.91.23.1.1"
DEVICE = 0xFFFF


def octets(net_id: str) -> bytes:
    return bytes(int(part) for part in net_id.split("."))


NAMES_OF_TYPES = ("INT8", "UINT8", "INT16", "UINT16", "INT32", "UINT32", "INT64", "UINT64",
                  "REAL32", "REAL64", "STRING", "BIT")  # fmt: skip
NAMES_OF_GROUPS = {
    "SYM_HNDBYNAME": IndexGroup.SYMBOL_HANDLE,
    "SYM_VALBYNAME": IndexGroup.VALUE_BY_NAME,
    "SYM_VALBYHND": IndexGroup.VALUE_BY_HANDLE,
    "SYM_RELEASEHND": IndexGroup.RELEASE_HANDLE,
    "SYM_INFOBYNAME": IndexGroup.SYMBOL_BY_NAME,
    "SYM_VERSION": IndexGroup.SYMBOL_VERSION,
    "SYM_INFOBYNAMEEX": IndexGroup.SYMBOL_ENTRY_BY_NAME,
    "SYM_UPLOAD": IndexGroup.SYMBOL_UPLOAD,
    "SYM_UPLOADINFO": IndexGroup.SYMBOL_UPLOAD_INFO,
    "SYM_DT_UPLOAD": IndexGroup.DATA_TYPE_UPLOAD,
    "SYM_UPLOADINFO2": IndexGroup.SYMBOL_UPLOAD_INFO_2,
    "SYMNOTE": IndexGroup.SYMBOL_NOTIFICATION,
    "SUMUP_READ": IndexGroup.SUM_READ,
    "SUMUP_WRITE": IndexGroup.SUM_WRITE,
    "DEVICE_DATA": IndexGroup.DEVICE_DATA,
}
NAMES_OF_MODES = ("CLIENT_CYCLE", "SERVER_CYCLE")


class Served:
    """A server and what stands behind it."""

    def __init__(self) -> None:
        self.store = DictStore()
        self.station = Station()
        self.master = FakeMaster()
        self.device, self.space = variable_device(self.store, self.station)
        self.address = own_address(0)
        self.server = AmsTcpServer(
            self.address,
            {
                (octets(NET_ID), DEVICE): self.device,
                (octets(NET_ID), 300): io_device(self.station),
                (octets(NET_ID), 10000): system_device(self.station),
                (bytes(BUS_NET_ID), DEVICE): master_device(self.master, self.station),
            },
        )

    def connect(self, port: int = DEVICE, net_id: str = NET_ID):
        return pyads.Connection(net_id, port, self.address)


@pytest.fixture
def served():
    here = Served()
    with here.server:
        yield here


class Watcher:
    """Notifications of one connection, taken back at the end whatever happens.

    AdsLib crashes when it closes a port that still has some.
    """

    def __init__(self, connection) -> None:
        self.connection = connection
        self.handles = []

    def add(self, name, attributes, kind):
        """Return the list to which every notification adds its handle, time stamp and value."""
        told = []

        def callback(notification, _):
            told.append(self.connection.parse_notification(notification, kind))

        self.handles.append(self.connection.add_device_notification(name, attributes, callback))
        return told

    def remove_all(self):
        while self.handles:
            self.connection.del_device_notification(*self.handles.pop())


@pytest.fixture
def plc(served):
    with served.connect() as connection:
        yield connection


@pytest.fixture
def watcher(plc):
    watcher = Watcher(plc)
    yield watcher
    watcher.remove_all()


def read_values(store):
    return {
        name: list(value) if isinstance(value, tuple | bytes) else value
        for name, value in ((name, store.get(name)) for name in VALUES)
    }


def test_numbers_are_those_of_pyads():
    constants = vars(pyads.constants)
    assert {name: constants[f"ADST_{name}"] for name in NAMES_OF_TYPES} == {
        name: AdsType[name] for name in NAMES_OF_TYPES
    }
    assert {n: constants[f"ADSIGRP_{n}"] for n in NAMES_OF_GROUPS} == NAMES_OF_GROUPS
    modes = {name: constants[f"ADSTRANS_{name.replace('_', '')}"] for name in NAMES_OF_MODES}
    assert modes == {name: TransMode[name] for name in NAMES_OF_MODES}
    states = {name: AdsState[name] for name in ("RESET", "INIT", "RUN", "STOP", "CONFIG")}
    assert states == {name: constants[f"ADSSTATE_{name}"] for name in states}
    assert constants["ADSSYMBOLFLAG_READONLY"] == SymbolFlag.READ_ONLY
    unknown = set(AdsError) - set(pyads.errorcodes.ERROR_CODES)
    assert not unknown


def test_info_and_states(plc, served):
    name, version = plc.read_device_info()
    assert (name, version.version, version.revision, version.build) == ("island-01", 3, 1, 4024)
    assert plc.read_state() == (AdsState.RUN, 8)
    plc.write_control(AdsState.STOP, 0, 0, pyads.PLCTYPE_INT)
    assert plc.read_state() == (AdsState.STOP, 4)
    assert served.station.al_state == 4
    with pytest.raises(pyads.ADSError) as refused:
        plc.write_control(AdsState.SHUTDOWN, 0, 0, pyads.PLCTYPE_INT)
    assert refused.value.err_code == AdsError.VALUE


def test_every_type_is_read_and_written_by_name(plc, served):
    assert {name: plc.read_by_name(name) for name in VALUES} == read_values(served.store)
    wanted = {
        "motor.speed": -2.25,
        "motor.on": False,
        "depth": -(1 << 23),
        "mode": 7,
        "name": "a pump of size",
        "curve": [5, 6, 7, 8],
        "raw": [9, 8, 7],
        "long": 1 << 62,
        "flags": 0xFFFF,
        "wide": [2, 3],
        "exact": 1e300,
    }
    for name, value in wanted.items():
        plc.write_by_name(name, value)
    assert read_values(served.store) == {**wanted, "count": 70_000}
    assert {name: plc.read_by_name(name) for name in VALUES} == read_values(served.store)


def test_refusals_have_their_codes(plc):
    for attempt, code in (
        (lambda: plc.read_by_name("nobody"), AdsError.SYMBOL_NOT_FOUND),
        (lambda: plc.write_by_name("count", 1), AdsError.ACCESS),
        (lambda: plc.write_by_name("depth", 1 << 23), AdsError.VALUE),
        (lambda: plc.write_by_name("name", "x" * 16), AdsError.SIZE),
        (lambda: plc.read(0x4040, 1 << 30, pyads.PLCTYPE_INT), AdsError.INDEX_OFFSET),
        (lambda: plc.read(0x1234, 0, pyads.PLCTYPE_INT), AdsError.INDEX_GROUP),
    ):
        with pytest.raises(pyads.ADSError) as refused:
            attempt()
        assert refused.value.err_code == code


def test_pyads_reads_and_writes_by_handle(plc, served):
    handle = plc.get_handle("motor.speed")
    assert plc.read_by_name("", pyads.PLCTYPE_REAL, handle=handle) == 1.5
    plc.write_by_name("", 4.0, pyads.PLCTYPE_REAL, handle=handle)
    assert served.store.get("motor.speed") == 4.0
    plc.release_handle(handle)


def test_pyads_lists_all_symbols(plc, served):
    symbols = {symbol.name: symbol for symbol in plc.get_all_symbols()}
    assert list(symbols) == list(VALUES)
    assert symbols["curve"].symbol_type == "ARRAY [0..3] OF INT"
    assert symbols["name"].symbol_type == "STRING(15)"
    assert symbols["motor.on"].comment == "comment of motor.on"
    assert {name: symbol.read() for name, symbol in symbols.items()} == read_values(served.store)
    symbols["motor.speed"].write(7.5)
    assert served.store.get("motor.speed") == 7.5


def test_lists_by_name(plc, served):
    names = list(VALUES)
    assert plc.read_list_by_name(names) == read_values(served.store)
    assert plc.read_list_by_name(names, ads_sub_commands=2) == read_values(served.store)
    errors = plc.write_list_by_name(
        {"motor.speed": 3.5, "count": 1, "name": "fan", "curve": [0] * 4}
    )
    assert list(errors.values()) == [
        "no error",
        pyads.errorcodes.ERROR_CODES[AdsError.ACCESS],
        "no error",
        "no error",
    ]
    assert served.store.get("motor.speed") == 3.5
    assert served.store.get("name") == "fan"
    assert served.store.get("curve") == (0, 0, 0, 0)


def test_notifications_on_change_and_cyclic(served, watcher):
    cyclic = pyads.NotificationAttrib(4, pyads.ADSTRANS_SERVERCYCLE, cycle_time=20, max_delay=50)
    changes = watcher.add("motor.speed", pyads.NotificationAttrib(4), pyads.PLCTYPE_REAL)
    cycles = watcher.add("count", cyclic, pyads.PLCTYPE_UDINT)
    wait_until(lambda: changes and len(cycles) >= 5)
    assert [value for *_, value in changes] == [1.5]
    handle, stamp, _ = changes[0]
    assert handle == watcher.handles[0][0]
    assert abs(stamp - dt.datetime.now(stamp.tzinfo)) < dt.timedelta(minutes=1)
    distance = (cycles[4][1] - cycles[0][1]).total_seconds()
    assert 0.05 < distance < 1.0
    with served.server.lock:
        served.store.set("motor.speed", 9.5)
    wait_until(lambda: len(changes) == 2)
    assert changes[1][2] == 9.5
    watcher.remove_all()
    assert served.device.notifications.stats().notifications == 0


def test_notification_that_the_server_ends_leaves_the_others_alone(plc, served, watcher):
    ended = watcher.add("count", pyads.NotificationAttrib(4), pyads.PLCTYPE_UDINT)
    kept = watcher.add("motor.speed", pyads.NotificationAttrib(4), pyads.PLCTYPE_REAL)
    wait_until(lambda: ended and kept)
    with served.server.lock:
        served.store.broken["count"] = AdsError.NOT_FOUND
        served.store.set("motor.speed", 2.5)
    wait_until(lambda: len(kept) == 2)
    wait_until(lambda: served.device.notifications.stats().ended == 1)
    with served.server.lock:
        served.store.set("motor.speed", 3.5)
    wait_until(lambda: [value for *_, value in kept] == [1.5, 2.5, 3.5])
    assert len(ended) == 1
    with pytest.raises(pyads.ADSError) as refused:
        plc.del_device_notification(*watcher.handles.pop(0))
    assert refused.value.err_code == AdsError.NOTIFICATION_HANDLE


def test_symbol_that_updates_itself(plc, served):
    symbol = plc.get_symbol("motor.speed", auto_update=True)
    wait_until(lambda: symbol.value == 1.5)
    with served.server.lock:
        served.store.set("motor.speed", 2.5)
    wait_until(lambda: symbol.value == 2.5)
    symbol.auto_update = False


DIES = """
import os, sys, time, pyads
plc = pyads.Connection(sys.argv[1], 0xFFFF, sys.argv[2])
plc.open()
plc.add_device_notification("count", pyads.NotificationAttrib(4), lambda *_: os._exit(0))
time.sleep(20)
sys.exit('was told nothing')
"""


def test_client_that_dies_takes_its_notifications_along(served, watcher):
    told = watcher.add("count", pyads.NotificationAttrib(4), pyads.PLCTYPE_UDINT)
    subprocess.run([sys.executable, "-c", DIES, NET_ID, served.address], timeout=30, check=True)
    wait_until(lambda: served.device.notifications.stats().notifications == 1)
    assert served.device.notifications.stats().clients == 1
    with served.server.lock:
        served.store.set("count", 5)
    wait_until(lambda: [value for *_, value in told] == [70_000, 5])


def test_system_service_and_device_list(served):
    with served.connect(10000) as system:
        assert system.read_state() == (AdsState.RUN, 8)
        state = system.read(0xF0, 0, ctypes.c_uint16 * 8)
        assert state[:3] == [AdsState.RUN, 1, 7]
    with served.connect(300) as server:
        assert server.read(0x5000, 2, pyads.PLCTYPE_UDINT) == 2
        assert server.read(0x5000, 1, ctypes.c_uint16 * 3) == [2, 1, 2]
        assert server.read(0x5002, 1, pyads.PLCTYPE_STRING) == "bus0"
        assert server.read(0x5002, 7, pyads.PLCTYPE_UINT) == 111
        assert server.read(0x5002, 5, ctypes.c_uint8 * 6) == list(BUS_NET_ID)


def test_pyads_reads_groups_of_the_master(served):
    with served.connect(net_id=str(BUS_NET_ID)) as master:
        assert master.read(3, 0x100, pyads.PLCTYPE_UINT) == 8
        assert master.read(6, 0, pyads.PLCTYPE_UINT) == 3
        assert master.read(7, 0, ctypes.c_uint16 * 3) == [1001, 1002, 1003]
        assert master.read(9, 0, ctypes.c_uint8 * 6) == [8, 0, 0x14, 0, 8, 1]
        assert master.read(9, 1002, ctypes.c_uint8 * 2) == [0x14, 0]
        master.write(3, 4, None, None)
        master.write(9, 1003, 2, pyads.PLCTYPE_UINT)
    assert served.master.asked == [(4,), (1003, 2)]


def test_rate_of_reads_is_that_of_a_loopback(plc):
    handle = plc.get_handle("count")
    start = time.perf_counter()
    for _ in range(500):
        assert plc.read(0xF005, handle, pyads.PLCTYPE_UDINT) == 70_000
    assert time.perf_counter() - start < 15.0  # of 20 s, if each waited for a late acknowledgement
