"""Common test set-up: the hypothesis profile, skipped tests with their reasons, quiet tests.

Tests marked ``net`` open sockets and start processes, on fixed addresses; they come after all
others.  Under xdist, where each file has one worker (``--dist loadfile``), every worker has a
network namespace of its own where it may make one; without, only one file of ``net`` tests runs at
a time.  There the files of running plants, which mostly wait, are spread among those that compute.
Tests marked ``quiet`` judge time: the other workers wait while one of them is called, not while its
fixtures are made.
"""

from __future__ import annotations

import ctypes
import fcntl
import gc
import importlib.util
import itertools
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Generator, Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

settings.register_profile(
    "full",
    derandomize=True,
    deadline=None,
    database=None,
    max_examples=100,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.register_profile("quick", settings.get_profile("full"), max_examples=10)
settings.load_profile("quick")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell starts what it puts into the background that way, and programs inherit it: those of
    # the tests would not hear the Ctrl-C that they are sent.
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Tests start hundreds of processes.  Where Python is told to keep no bytecode, each of them would
# compile all that it imports.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# A width that readline found out for pytest goes on to xdist's workers: tables would follow it.
os.environ.pop("COLUMNS", None)

_CAPABILITIES = {"CAP_NET_ADMIN": 12, "CAP_NET_RAW": 13, "CAP_SYS_ADMIN": 21}
"""Capabilities for a network namespace with a veth pair and a raw socket: name to bit."""

_CLONE_NEWNET = 0x40000000

_TURN_S = 300.0
"""Longest time for which a quiet test waits until the others have finished theirs."""
_TURN = os.open(__file__, os.O_RDONLY)  # only ever locked, as is the next one
_QUEUE = os.open(Path(__file__).parent / "support" / "eventually.py", os.O_RDONLY)


def _lacks_root() -> str | None:
    """Say why this process cannot make network namespaces and raw sockets, or None if it can."""
    if os.geteuid() != 0:
        return "needs root (namespaces, raw sockets); run the tests as root"
    status = Path("/proc/self/status").read_text()
    held = int(status.partition("CapEff:")[2].split()[0], 16)
    for name, bit in _CAPABILITIES.items():
        if not held >> bit & 1:
            return f"needs {name}, which root does not have here (a container without it?)"
    return _lacks_program("ip", package="iproute2")


def _lacks_host_root() -> str | None:
    """Say why this process is not root of the machine itself, or None if it is."""
    mapped = Path("/proc/self/uid_map").read_text().split()
    if os.geteuid() == 0 and mapped == ["0", "0", "4294967295"]:
        return None
    return "needs root outside a user namespace; run the tests as root"


def _lacks_program(name: str, *, package: str) -> str | None:
    if shutil.which(name, path=f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin") is None:
        return f"needs {name}; to install: apt-get install {package}"
    return None


def _lacks_browser() -> str | None:
    if shutil.which("chromium"):
        return None
    return _lacks_program("chromium-headless-shell", package="chromium-headless-shell")


def _lacks_module(name: str, *, package: str) -> str | None:
    if importlib.util.find_spec(name) is None:
        return f"needs {name}; to install: pip install {package}"
    return None


def _enter_own_network() -> bool:
    """Give this worker a network namespace of its own, where its fixed addresses are free.

    Returns:
        Whether it has one; without the privilege it shares the network of all others.
    """
    if _lacks_root() is not None:
        return False
    library = ctypes.CDLL(None, use_errno=True)
    if library.unshare(_CLONE_NEWNET):
        return False
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
    return True


_HAS_OWN_NETWORK = "PYTEST_XDIST_WORKER" in os.environ and _enter_own_network()


@pytest.fixture(scope="session", autouse=True)
def state_dir_of_all(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep configurations away from the user's own; for appliances that several tests share."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("EAP_STATE_DIR", str(tmp_path_factory.mktemp("state") / "eap"))
        yield


_STATES = itertools.count()


@pytest.fixture(autouse=True)
def state_dir() -> Iterator[None]:
    """Give each test a place for configurations of its own; it is made when it is needed."""
    before = os.environ["EAP_STATE_DIR"]
    os.environ["EAP_STATE_DIR"] = f"{before}-{next(_STATES)}"  # monkeypatch takes ten times as long
    yield
    os.environ["EAP_STATE_DIR"] = before


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Run three workers a core: most of what tests of running plants do is to wait.

    Unit tests compute, so a core is busy with one worker; each collects all tests for itself.
    """
    cores = os.cpu_count() or 1
    are_units = all("unit" in Path(each).parts for each in config.args)
    return min(cores + 1 if are_units else 3 * cores, 8)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip tests for which this machine lacks something, and put tests with sockets last."""
    missing = {
        "root": _lacks_root(),
        "host_root": _lacks_host_root(),
        "tshark": _lacks_program("tshark", package="tshark"),
        "mosquitto": _lacks_program("mosquitto", package="mosquitto")
        or _lacks_program("mosquitto_sub", package="mosquitto-clients")
        or _lacks_program("openssl", package="openssl"),
        "prometheus": _lacks_program("prometheus", package="prometheus"),
        "chromium": _lacks_browser() or _lacks_module("playwright", package="playwright"),
    }
    for item in items:
        for marker, reason in missing.items():
            if reason is not None and item.get_closest_marker(marker) is not None:
                item.add_marker(pytest.mark.skip(reason=reason))
        if _is_quiet(item):
            own = item.get_closest_marker("timeout")
            limit_s = own.args[0] if own else float(item.config.getini("timeout"))
            item.add_marker(pytest.mark.timeout(limit_s + _TURN_S), append=False)
    items.sort(key=_is_net)
    if "PYTEST_XDIST_WORKER" in os.environ:
        _spread(items)


def _spread(items: list[pytest.Item]) -> None:
    """Order files so that no worker computes alone and none begins a long file at the end.

    Quiet tests come first: later each of them would wait for whatever runs beside it.
    """
    items.sort(key=lambda item: not _is_quiet(item))
    files: dict[Path, list[pytest.Item]] = {}
    for item in items:
        files.setdefault(item.path, []).append(item)
    first = [path for path in files if any(map(_is_quiet, files[path]))]
    rest = [path for path in files if path not in first]
    plants = sorted(filter(_runs_plants, rest), key=_place)
    others = [path for path in rest if not _runs_plants(path)]
    share = -(-len(others) // max(len(plants), 1))
    for number in range(max(len(plants), 1)):
        first += plants[number : number + 1] + others[number * share : (number + 1) * share]
    items[:] = (item for path in first for item in files[path])


_LONGEST = (
    "change_plant", "web_browser", "ring", "mqtt", "opcua", "live_frames", "change_buses",
    "discover", "bus_station", "bus_ports", "processes", "attacks_on_users", "attacks",
    "recordings_docs", "configure_docs", "connection_limits", "change_ports", "several_hosts",
    "bus_commands", "recording", "top", "field_docs", "stores", "subscribers", "demo_docs",
    "killed_processes", "ordinary_user", "terminals_docs", "types_docs", "recording_day",
    "interface_again", "kickcat", "dissect", "scan_plant", "eap_device", "web", "replay",
    "hostile_slaves", "hostile_hosts", "control_docs", "gateway", "routes", "paths",
    "mqtt_values", "pyads_clients", "refusals", "plant_recordings", "commands", "clock_lock",
    "valve", "routes_docs", "poll", "from_twincat", "ams_uplinks", "bridges", "monitoring",
)  # fmt: skip
"""Files of running plants by their duration, before all others, by their size."""


def _runs_plants(path: Path) -> bool:
    return path.parent.name in {"integration", "interop"}


def _place(path: Path) -> tuple[int, int]:
    name = path.stem.removeprefix("test_")
    place = _LONGEST.index(name) if name in _LONGEST else len(_LONGEST)
    return place, -path.stat().st_size


gc.disable()  # until all tests are collected: what that makes stays


def pytest_collection_finish() -> None:
    """Let the garbage collector pass over the thousands of tests that are there to the end."""
    gc.freeze()  # garbage of the collection, too: to find it takes longer than to keep it
    gc.enable()
    gc.set_threshold(20_000, 20, 20)


class _Turns:
    """Locks between the workers of xdist: many tests at a time, or one that is alone.

    Attributes:
        is_kept: Whether the next test of this worker is to be alone, too.
    """

    def __init__(self) -> None:
        self._is_alone = False
        self.is_kept = False

    def take(self, *, alone: bool) -> None:
        """Wait until a test may run beside others, or *alone*; one that is alone remains so."""
        if self._is_alone:
            return
        # A worker that waits to be alone holds the queue, so that no further test begins meanwhile.
        fcntl.flock(_QUEUE, fcntl.LOCK_EX)
        fcntl.flock(_TURN, fcntl.LOCK_EX if alone else fcntl.LOCK_SH)
        fcntl.flock(_QUEUE, fcntl.LOCK_UN)
        self._is_alone = alone

    def become_alone(self) -> None:
        """Wait until no other test runs, and remain alone."""
        if not self._is_alone:
            self.give_back()
            self.take(alone=True)

    def give_back(self) -> None:
        """Let others run."""
        fcntl.flock(_TURN, fcntl.LOCK_UN)
        self._is_alone = False


_TURNS = _Turns()


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(
    item: pytest.Item, nextitem: pytest.Item | None
) -> Generator[None, object, object]:
    """Under xdist, run beside other tests; without networks of their own, one file at a time.

    Outside pytest-timeout's wrapper, so that waiting for a turn costs no test its time.
    """
    if "PYTEST_XDIST_WORKER" not in os.environ:
        return (yield)
    is_alone = _is_net(item) and not _HAS_OWN_NETWORK
    is_last = nextitem is None or nextitem.path != item.path
    # What the tests of a file share runs, on fixed addresses, until the last of them is over.
    # Between two quiet tests all others would have to begin and end one.
    _TURNS.is_kept = not is_last and (is_alone or (_is_quiet(item) and _is_quiet(nextitem)))
    _TURNS.take(alone=is_alone)
    try:
        return (yield)
    finally:
        if not _TURNS.is_kept:
            _TURNS.give_back()


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, object, object]:
    """Under xdist, let a test that judges time have the machine to itself."""
    is_alone = _is_net(item) and not _HAS_OWN_NETWORK
    if "PYTEST_XDIST_WORKER" not in os.environ or not _is_quiet(item) or is_alone:
        return (yield)
    _TURNS.become_alone()
    try:
        return (yield)
    finally:
        if not _TURNS.is_kept:
            _TURNS.give_back()
            _TURNS.take(alone=False)


def _is_quiet(item: pytest.Item) -> bool:
    return item.get_closest_marker("quiet") is not None


def _is_net(item: pytest.Item) -> bool:
    return item.get_closest_marker("net") is not None
