"""The Debian package in a clean Debian: installed, run by systemd, upgraded, removed, purged.

``make test-package`` builds the package first.  The tests of this file follow each other.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.debianroot import DebianRoot
from tools.package import deb

DIST = Path(__file__).parents[2] / "dist"
CAPABILITIES = 1 << 13 | 1 << 14 | 1 << 23
"""CAP_NET_RAW, CAP_IPC_LOCK, CAP_SYS_NICE."""
EXPECTED_LEFT = re.compile(
    r"/var/(log|cache|lib/(dpkg|apt|systemd|logrotate))/.*|/etc/(passwd|group|shadow|gshadow|subuid|subgid)-"
)
"""Records of dpkg, apt, adduser and logrotate themselves."""

pytestmark = [pytest.mark.net, pytest.mark.timeout(900)]


@pytest.fixture(scope="module")
def package() -> Path:
    found = sorted(DIST.glob("*.deb"), key=lambda path: path.stat().st_mtime)
    if not found:
        pytest.skip("no package in dist/: make deb")
    return found[-1]


@pytest.fixture(scope="module")
def debian(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DebianRoot]:
    folder = tmp_path_factory.mktemp("debian")
    with DebianRoot(folder) as root:
        yield root.wait_booted()
    shutil.rmtree(folder)


@pytest.fixture(scope="module")
def before(debian: DebianRoot) -> set[str]:
    return debian.files()


def install(debian: DebianRoot, package: Path) -> str:
    shutil.copyfile(package, debian.folder / "opt/package.deb")
    try:
        return debian.run("apt-get install -y --no-install-recommends /opt/package.deb 2>&1")
    finally:
        (debian.folder / "opt/package.deb").unlink()


def status(debian: DebianRoot) -> dict:
    return json.loads(debian.run("eapctl status --json"))


def shown(debian: DebianRoot, name: str) -> str:
    return debian.run(f"systemctl show -P {name} eap@demo").strip()


def test_package_of_the_same_commit_has_the_same_bytes(package, tmp_path):
    wheels = sorted(DIST.glob("*.whl"), key=lambda path: path.stat().st_mtime)
    again = deb.build(wheels[-1], tmp_path)
    assert again.name == package.name
    one, other = (hashlib.sha256(path.read_bytes()).hexdigest() for path in (package, again))
    assert one == other
    bill = json.loads(again.with_suffix(".cdx.json").read_text())
    names = {each["name"] for each in bill["components"]}
    assert {"msgspec", "PyYAML", "aiohttp", "uPlot"} <= names


def test_package_brings_command_user_plant_and_pages(debian, before, package):
    assert not any("eap-appliance" in path for path in before)
    install(debian, package)
    version = debian.run("dpkg-query -W -f '${Version}' eap-appliance")
    assert deb.debian_version(debian.run("eapctl --version").split()[1]) == version
    assert ":/var/lib/eap:/usr/sbin/nologin" in debian.run("getent passwd eap")
    assert "no errors (plant demo: 3 stations" in debian.run("eapctl check /etc/eap/demo.yaml")
    assert "no errors" in debian.run(
        "cd /tmp && eapctl new x.yaml --from valve && eapctl check x.yaml"
    )
    pages = debian.run("ls /usr/share/man/man1/eapctl*")
    assert all(f"/eapctl{name}.1.gz" in pages for name in ("", "-run", "-pd-set", "-bus-foe-put"))
    assert debian.run("python3 -c 'import eap' 2>&1 || echo hidden").endswith("hidden\n")
    assert debian.run("PYTHONPATH=/usr/lib/eap-appliance python3 -c 'import eap'") == ""


def test_unit_is_hardened(debian):
    unit = "/usr/lib/systemd/system/eap@.service"
    # In tenths: at most 3.0.
    print(debian.run(f"systemd-analyze security --offline=true --threshold=30 {unit}")[-200:])
    debian.run("systemd-analyze verify --man=no eap@demo.service")


def test_plant_runs_as_the_service_user_without_root(debian):
    debian.run("systemctl start eap@demo")
    assert shown(debian, "ActiveState") == "active", "systemd got the readiness"
    assert "plant demo: island-01, island-02, island-03" in shown(debian, "StatusText")
    number = debian.run("id -u eap").strip()
    group = shown(debian, "ControlGroup")
    pids = debian.run(f"cat /sys/fs/cgroup{group}/cgroup.procs").split()
    assert len(pids) >= 6
    for pid in pids:
        text = debian.run(f"cat /proc/{pid}/status")
        assert re.findall(r"^Uid:\s+(\d+)", text, re.MULTILINE) == [number]
        held = re.findall(r"^Cap(?:Eff|Prm|Bnd):\s+(\w+)", text, re.MULTILINE)
        assert {int(each, 16) for each in held} == {CAPABILITIES}
    document = status(debian)
    assert [each["name"] for each in document["stations"]] == [f"island-0{n}" for n in (1, 2, 3)]
    assert "sched_fifo" not in debian.run("eapctl status --full").lower()
    # The service user sees its plant, and no other user.
    debian.run("setpriv --reuid eap --regid eap --init-groups eapctl status")
    assert debian.attempt("setpriv --reuid 65534 --clear-groups eapctl status").returncode != 0


def test_service_is_started_again_when_its_first_process_dies(debian):
    debian.run(f"kill -9 {shown(debian, 'MainPID')}")
    debian.wait_for(
        "systemctl show -P NRestarts,ActiveState eap@demo; systemctl is-active eap@demo",
        lambda text: text.endswith("\nactive\n") and text.startswith("1"),
    )


def test_log_is_in_the_journal_with_fields(debian):
    command = "journalctl --unit eap@demo --output json EAP_PROCESS=supervisor"
    debian.run(f"kill -9 {status(debian)['processes']['engine']['pid']}")
    debian.wait_for(command, lambda text: "engine runs again" in text)
    entries = [json.loads(line) for line in debian.run(command).splitlines()]
    (entry,) = (each for each in entries if "engine ended" in each["MESSAGE"])
    assert entry["MESSAGE"].startswith("supervisor: engine ended (killed by SIGKILL)")
    assert (entry["PRIORITY"], entry["EAP_PLANT"]) == ("4", "demo")
    assert (entry["EAP_AREA"], entry["SYSLOG_IDENTIFIER"]) == ("supervisor", "eapctl")
    assert entry["_SYSTEMD_UNIT"] == "eap@demo.service"


def test_upgrade_keeps_state_and_goes_on(debian, package, tmp_path):
    debian.run("eapctl state island-02 PREOP && echo '# mine' >> /etc/eap/demo.yaml")
    first = shown(debian, "MainPID")
    install(debian, newer(package, tmp_path))
    assert debian.run("dpkg-query -W -f '${Version}' eap-appliance").endswith("+next")
    assert shown(debian, "MainPID") not in {first, "0"}
    states = {each["name"]: each["state"] for each in status(debian)["stations"]}
    assert states == {"island-01": "OP", "island-02": "PREOP", "island-03": "OP"}
    assert debian.run("tail -1 /etc/eap/demo.yaml") == "# mine\n"
    assert '"operation":"request_state"' in debian.run("cat /var/lib/eap/demo/audit.jsonl")


def newer(package: Path, folder: Path) -> Path:
    """Return the same package with a later version."""
    tree = folder / "tree"
    subprocess.run(["dpkg-deb", "-R", str(package), str(tree)], check=True)
    control = tree / "DEBIAN/control"
    control.write_text(re.sub(r"(?m)^(Version: .*)$", r"\1+next", control.read_text()))
    result = folder / "next.deb"
    subprocess.run(
        ["dpkg-deb", "-Znone", "--root-owner-group", "-b", str(tree), str(result)], check=True
    )
    return result


def test_changed_plant_file_is_applied_by_reload(debian):
    debian.run("eapctl state island-02 OP")
    debian.run("sed -i 's/timeout_ms: 5000/timeout_ms: 4000/' /etc/eap/demo.yaml")
    first = shown(debian, "MainPID")
    debian.run("systemctl reload eap@demo")
    assert shown(debian, "MainPID") == first
    assert "no differences" in debian.run("eapctl plan /etc/eap/demo.yaml")


def test_audit_is_rotated_and_written_further(debian):
    debian.run("logrotate --force /etc/logrotate.d/eap-appliance")
    debian.run("eapctl pd set island-01 setpoint 60")
    assert '"operation":"write"' in debian.run("cat /var/lib/eap/demo/audit.jsonl")
    assert len(debian.run("ls /var/lib/eap/demo/audit.jsonl*").split()) == 2


def test_watchdog_restarts_a_plant_that_hangs(debian):
    debian.run(
        "mkdir -p /run/systemd/system/eap@demo.service.d &&"
        " printf '[Service]\\nWatchdogSec=8s\\n' > /run/systemd/system/eap@demo.service.d/w.conf &&"
        " systemctl daemon-reload && systemctl restart eap@demo"
    )
    first = shown(debian, "MainPID")
    debian.run(f"kill -STOP {status(debian)['processes']['engine']['pid']}")
    debian.wait_for(
        "systemctl show -P MainPID eap@demo", lambda text: text.strip() not in {first, "0"}
    )
    assert "watchdog" in debian.run("journalctl -u eap@demo --no-pager").lower()


def test_removed_package_keeps_its_state_and_purge_leaves_nothing(debian, before):
    debian.run("systemctl enable eap@demo 2>&1")
    debian.run("apt-get remove -y eap-appliance 2>&1")
    assert debian.attempt("systemctl is-active eap@demo").returncode != 0
    assert debian.attempt("eapctl --version").returncode == 127
    assert "audit.jsonl" in debian.run("ls /var/lib/eap/demo /etc/eap/demo.yaml")
    debian.run("apt-get purge -y eap-appliance 2>&1")
    left = debian.files() - before
    assert [path for path in sorted(left) if not EXPECTED_LEFT.fullmatch(path)] == []
    assert debian.attempt("getent passwd eap").returncode != 0
    assert debian.attempt("getent group eap").returncode != 0
    assert debian.run("ls /run | grep -c '^eap$' || true") == "0\n"
