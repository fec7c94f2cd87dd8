"""Real-time settings of processes, tried on real ones: the test's own must stay as it is."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from eap.net.realtime import descriptor_reserve, raise_descriptor_limit, spare_descriptors
from tests.support.eventually import wait_until

pytestmark = pytest.mark.net

REPORT = """
import gc, json, os, sys
from eap.net import realtime
{before}
report = realtime.prepare({priority}, {cpus})
report["gc"] = gc.isenabled()
report["frozen"] = gc.get_freeze_count() > 0
report["policy"] = os.sched_getscheduler(0)
report["affinity"] = sorted(os.sched_getaffinity(0))
print(json.dumps(report))
"""
CHILD = """
import signal, sys
from eap.net import realtime
realtime.die_with_parent(int(sys.argv[1]), signal.SIGTERM)
print("alive", flush=True)
signal.pause()
"""
PARENT = f"""
import os, subprocess, sys
child = subprocess.Popen([sys.executable, "-c", {CHILD!r}, str(os.getpid())])
print(child.pid, flush=True)
child.wait()
"""


def prepare(priority=50, cpus="()", before="", prefix=()):
    script = REPORT.format(priority=priority, cpus=cpus, before=before)
    done = subprocess.run(
        [*prefix, sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout)


@pytest.mark.host_root
def test_raise_process_priority_without_the_right_is_no_error():
    script = "import os\nfrom eap.net.realtime import raise_process_priority as call\ncall(-10)\n"
    script += "print(os.getpriority(os.PRIO_PROCESS, 0))"
    command = [sys.executable, "-c", script]
    shares = [
        subprocess.run([*prefix, *command], capture_output=True, text=True, check=True).stdout
        for prefix in ([], ["setpriv", "--bounding-set=-sys_nice"])
    ]
    assert shares == ["-10\n", "0\n"]


@pytest.mark.host_root
def test_root_gets_everything():
    report = prepare(cpus="(0,)")
    assert report["scheduler"] == "fifo 50"
    assert report["policy"] == os.SCHED_FIFO
    assert report["cpus"] == report["affinity"] == [0]
    assert report["memory_locked"] is True
    assert report["timer_slack_ns"] in {0, 1}  # 0 from Linux 6.12 on for a real-time process
    assert report["pm_qos"] is True or "/dev/cpu_dma_latency" in report["pm_qos"]
    assert (report["gc"], report["frozen"]) == (False, True)


@pytest.mark.host_root
def test_ordinary_user_gets_reasons():
    before = (
        "import resource\n"
        "resource.setrlimit(resource.RLIMIT_MEMLOCK, (65536, 65536))\n"
        "resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))"
    )
    # The user may not see this tree: everything is imported before it becomes one.
    drop = "os.setgroups([]); os.setresgid(65534, 65534, 65534); os.setresuid(65534, 65534, 65534)"
    report = prepare(before=f"{before}\n{drop}")
    assert report["scheduler"].startswith("other: needs CAP_SYS_NICE")
    assert report["policy"] == os.SCHED_OTHER
    assert report["memory_locked"].endswith("(ulimit -l is 64 kB)")
    assert report["pm_qos"] is True or "/dev/cpu_dma_latency" in report["pm_qos"]
    assert report["timer_slack_ns"] == 1
    assert report["gc"] is False


def test_wrong_processor_and_priority_are_reported():
    report = prepare(priority=0, cpus="(4095,)")
    assert report["scheduler"] == "other: not requested"
    assert report["cpus"] == "Invalid argument: [4095]"
    report = prepare(priority=1000)
    assert report["scheduler"] == "other: Invalid argument (priority 1000)"


def is_alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z"
    except FileNotFoundError:
        return False


def test_child_dies_with_its_parent():
    with subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE) as parent:
        child = int(parent.stdout.readline())
        assert parent.stdout.readline() == b"alive\n"
        parent.kill()
        parent.wait()
        wait_until(lambda: not is_alive(child))


def test_die_with_parent_ends_orphan_at_once():
    done = subprocess.run([sys.executable, "-c", CHILD, "1"], capture_output=True, check=False)
    assert (done.returncode, done.stdout) == (-signal.SIGTERM, b"")


@pytest.mark.parametrize(
    ("limit", "reserve"), [(60, 15), (1024, 128), (resource.RLIM_INFINITY, 128)]
)
def test_reserve_is_a_quarter_of_a_small_limit(
    monkeypatch: pytest.MonkeyPatch, limit: int, reserve: int
) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _: (limit, limit))
    assert descriptor_reserve() == reserve
    if limit == 60:
        assert [spare_descriptors(fd, reserve) for fd in (43, 44, 50)] == [1, 0, -6]


def test_raise_descriptor_limit_reaches_the_hard_limit_and_the_children() -> None:
    script = (
        "import resource, subprocess, sys\n"
        "from eap.net.realtime import raise_descriptor_limit\n"
        "resource.setrlimit(resource.RLIMIT_NOFILE, (50, 90))\n"
        "assert raise_descriptor_limit() == 90\n"
        "print(subprocess.check_output(['sh', '-c', 'ulimit -n']).decode().strip())\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, check=True)
    assert done.stdout.strip() == b"90"


def test_raise_descriptor_limit_without_permission_keeps_the_soft_limit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(1, os.strerror(1))

    monkeypatch.setattr(resource, "getrlimit", lambda _: (7, 9))
    monkeypatch.setattr(resource, "setrlimit", refuse)
    assert raise_descriptor_limit() == 7
