"""The Ansible role on two hosts: Debian roots with systemd, reached by SSH over a bridge.

They are set up, upgraded one after the other, and a faulty plant file stops at the first.
``make test-package`` builds the package first.  The tests of this file follow each other.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

import pytest

from tests.support.appliance import wait_until
from tests.support.debianroot import DebianRoot
from tests.support.namespaces import Namespace, namespace

ROOT = Path(__file__).parents[2]
PROGRAMS = Path(sys.executable).parent
PLAYBOOK = PROGRAMS / "ansible-playbook"

pytestmark = [
    pytest.mark.net,
    pytest.mark.root,
    pytest.mark.timeout(1800),
    pytest.mark.skipif(
        not PLAYBOOK.exists(), reason="needs ansible-core: pip install --group deploy"
    ),
    pytest.mark.skipif(shutil.which("ssh") is None, reason="needs ssh: openssh-client"),
]

HOSTS = {"cell-a": ("10.77.0.1", "10.77.0.11"), "cell-b": ("10.77.0.2", "10.77.0.12")}
CONTROL = "10.77.0.254"


def station(name: str, address: str, number: int, target: str, source: str) -> str:
    """Return a station that sends a counter to *target* and receives that of *source*."""
    return f"""\
  - name: {name}
    net_id: {address}.1.1
    ports: [{{name: eap0, kind: eap, interface: "udp://{address}", net_id: {address}.2.1}}]
    variables: {{count: UDINT}}
    sources: {{count: {{kind: counter}}}}
    frames: [{{name: out, port: eap0, to: {target}/eap0}}]
    publish: [{{name: state, frame: out, id: {number}, variables: [count]}}]
    subscribe: [{{name: from-{source}, port: eap0, from: {source}/state, timeout_ms: 500}}]
    access: [{{name: engineers, allow: [configure], from: [10.77.0.0/24]}}]
"""


# oven and panel are on different hosts, and so are mill and lamp.
PLANT = (
    """\
plant: line
hosts:
  - {name: cell-a, address: 10.77.0.1, addresses: [10.77.0.11], user: root, stations: [oven, mill]}
  - {name: cell-b, address: 10.77.0.2, addresses: [10.77.0.12], user: root, stations: [panel, lamp]}
stations:
"""
    + station("oven", "10.77.0.1", 1, "panel", "mill")
    + station("mill", "10.77.0.11", 2, "oven", "lamp")
    + station("panel", "10.77.0.2", 3, "lamp", "oven")
    + station("lamp", "10.77.0.12", 4, "mill", "panel")
)
"""A ring: oven to panel to lamp to mill to oven."""
WITHIN = {"panel": "lamp", "mill": "oven"}
"""Senders and receivers on the same host."""


class Plant:
    """Two booted hosts without the package, and the computer with Ansible."""

    def __init__(self, folder: Path, control: Namespace, stack: ExitStack) -> None:
        self.folder = folder
        self.control = control
        self.file = folder / "line.yaml"
        self.file.write_text(PLANT)
        key = folder / "key"
        subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(key)], check=True)
        self.key = key
        control.ip("link", "add", "hub", "type", "bridge")
        control.ip("addr", "add", f"{CONTROL}/24", "dev", "hub")
        control.ip("link", "set", "hub", "up")
        self.hosts = {name: self._boot(name, stack) for name in HOSTS}
        for name, root in self.hosts.items():
            root.wait_booted()
            self._plug(name, root)

    def _boot(self, name: str, stack: ExitStack) -> DebianRoot:
        folder = self.folder / name
        folder.mkdir()
        root = stack.enter_context(DebianRoot(folder))
        keys = folder / "root/.ssh/authorized_keys"
        keys.parent.mkdir(mode=0o700, exist_ok=True)
        keys.write_text(self.key.with_suffix(".pub").read_text())
        return root

    def _plug(self, name: str, root: DebianRoot) -> None:
        """Lay a cable from the bridge to a host, which gets its addresses."""
        plug = f"to-{name}"
        peer = ("type", "veth", "peer", "name", "eth0", "netns", str(root.pid))
        self.control.ip("link", "add", plug, *peer)
        self.control.ip("link", "set", plug, "master", "hub", "up")
        for address in HOSTS[name]:
            root.run(f"ip addr add {address}/24 dev eth0")
        root.run("ip link set eth0 up")
        root.run("systemctl restart ssh")

    def play(self, *options: str, package: Path | None = None) -> tuple[int, str, dict[str, Any]]:
        """Run the playbook; return exit code, output, and the numbers of its recap by host."""
        variables = {
            "EAP_PLANT_FILE": str(self.file),
            "ANSIBLE_HOST_KEY_CHECKING": "False",
            "ANSIBLE_LOCAL_TEMP": str(self.folder / "ansible"),
            "PATH": f"{PROGRAMS}:{os.environ['PATH']}",
        }
        given = ["-e", f"eap_package={package}"] if package else []
        words = [str(PLAYBOOK), "-i", str(ROOT / "deploy/ansible/inventory"), *given, *options]
        done = subprocess.run(
            [
                *self.control.prefix,
                *words,
                "--private-key",
                str(self.key),
                "deploy/ansible/site.yml",
            ],
            capture_output=True,
            text=True,
            check=False,
            cwd=ROOT,
            env={**os.environ, **variables},
        )
        recap = re.findall(r"^(cell-\w) +: (.*)$", done.stdout, re.MULTILINE)
        numbers = {
            name: {key: int(value) for key, value in re.findall(r"(\w+)=(\d+)", text)}
            for name, text in recap
        }
        return done.returncode, done.stdout + done.stderr, numbers

    def status(self, name: str) -> dict[str, Any] | None:
        """Return the status of a host's appliance, None while none answers."""
        done = self.hosts[name].attempt("eapctl status --json")
        document: dict[str, Any] | None = json.loads(done.stdout) if done.stdout else None
        return document if document and document["stations"] else None

    def received(self, name: str) -> dict[str, dict[str, Any]]:
        """Return the PDs that a host receives, by station."""
        document = self.status(name)
        stations = document["stations"] if document else []
        return {each["name"]: each["pd"]["rx"][0] for each in stations}


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Plant]:
    folder = tmp_path_factory.mktemp("hosts")
    with ExitStack() as stack:
        yield Plant(folder, stack.enter_context(namespace()), stack)
    shutil.rmtree(folder)


@pytest.fixture(scope="module")
def package() -> Path:
    found = sorted((ROOT / "dist").glob("*.deb"), key=lambda path: path.stat().st_mtime)
    if not found:
        pytest.skip("no package in dist/: make deb")
    return found[-1]


@pytest.fixture(scope="module")
def next_package(package: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same package as that of the next release."""
    folder = tmp_path_factory.mktemp("next")
    tree = folder / "tree"
    subprocess.run(["dpkg-deb", "-R", str(package), str(tree)], check=True)
    control = tree / "DEBIAN/control"
    control.write_text(re.sub(r"(?m)^Version: .*$", "Version: 0.2.0", control.read_text()))
    (release,) = tree.glob("usr/lib/eap-appliance/**/eap/release.py")
    text = release.read_text()
    assert 'RELEASE = "0.1.0"' in text
    release.write_text(text.replace('RELEASE = "0.1.0"', 'RELEASE = "0.2.0"'))
    architecture = package.stem.rpartition("_")[2]
    made = folder / f"eap-appliance_0.2.0_{architecture}.deb"
    subprocess.run(
        ["dpkg-deb", "--root-owner-group", "-Zgzip", "-z1", "-b", str(tree), str(made)],
        check=True,
        capture_output=True,
    )
    return made


def test_check_on_new_hosts_changes_nothing(plant: Plant, package: Path) -> None:
    code, text, recap = plant.play("--check", package=package)
    assert code == 0, text
    assert all(each["changed"] > 0 and not each["failed"] for each in recap.values()), text
    for root in plant.hosts.values():
        assert root.attempt("test -e /etc/eap || command -v eapctl").returncode


def test_role_sets_up_both_hosts(plant: Plant, package: Path) -> None:
    code, text, recap = plant.play(package=package)
    assert code == 0, text
    assert recap.keys() == HOSTS.keys()
    for name, root in plant.hosts.items():
        assert root.run("systemctl is-active eap@line").strip() == "active"
        assert root.run("systemctl is-enabled eap@line").strip() == "enabled"
        document = plant.status(name)
        assert document is not None
        assert document["appliances"][0]["host"] == name
        for pd in plant.received(name).values():
            assert (pd["state"], pd["lost"]) == ("running", 0)
        user = root.run("ps -o user= -p $(systemctl show -P MainPID eap@line)")
        assert user.strip() == "eap"


def test_second_run_changes_nothing(plant: Plant, package: Path) -> None:
    pids = [plant.hosts[name].run("systemctl show -P MainPID eap@line") for name in HOSTS]
    for options in ((), ("--check",)):
        code, text, recap = plant.play(*options, package=package)
        assert code == 0, text
        assert [each["changed"] for each in recap.values()] == [0, 0], text
    assert pids == [plant.hosts[name].run("systemctl show -P MainPID eap@line") for name in HOSTS]


class Observer:
    """Looks at both hosts while the role works.

    Attributes:
        samples: Status of both hosts, in turn; None for one that did not answer.
    """

    def __init__(self, plant: Plant) -> None:
        self.samples: list[dict[str, dict[str, Any] | None]] = []
        self._plant = plant
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._look)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()

    def _look(self) -> None:
        while not self._end.wait(0.2):
            self.samples.append({name: self._plant.status(name) for name in HOSTS})


def supervisor(document: dict[str, Any]) -> int:
    pid: int = document["processes"]["supervisor"]["pid"]
    return pid


def test_upgrade_takes_one_host_after_the_other_and_loses_nothing_else(
    plant: Plant, next_package: Path
) -> None:
    old = {name: supervisor(plant.status(name) or {}) for name in HOSTS}
    with Observer(plant) as observer:
        code, text, _ = plant.play(package=next_package)
    assert code == 0, text
    new = {name: supervisor(plant.status(name) or {}) for name in HOSTS}
    assert all(old[name] != new[name] for name in HOSTS)
    # One restart of each host, and never both at once.
    seen: dict[str, set[int]] = {name: set() for name in HOSTS}
    for sample in observer.samples:
        for name, document in sample.items():
            if document:
                seen[name].add(supervisor(document))
        assert any(sample.values())
    assert seen == {name: {old[name], new[name]} for name in HOSTS}
    for document in (each for sample in observer.samples for each in sample.values() if each):
        received = {each["name"]: each["pd"]["rx"][0] for each in document["stations"]}
        for pd in received.values():
            assert (pd["lost"], pd["duplicated"], pd["reordered"]) == (0, 0, 0)
        # Within a host everything that was sent since its start has arrived, whatever the other
        # host does meanwhile; one or two are under way, or between the looks at two stations.
        for each in document["stations"]:
            if each["name"] in WITHIN:
                target = received[WITHIN[each["name"]]]
                assert abs(each["pd"]["tx"][0]["sent"] - target["received"]) < 10
    releases = {
        each["release"]
        for sample in observer.samples
        for document in filter(None, sample.values())
        for each in document["appliances"]
    }
    assert releases == {"0.1.0", "0.2.0"}
    for name in HOSTS:
        document = plant.status(name)
        assert document is not None
        assert document["appliances"][0]["release"] == "0.2.0"


def test_change_by_eapctl_and_then_by_the_role_needs_no_restart(plant: Plant) -> None:
    pids = [plant.hosts[name].run("systemctl show -P MainPID eap@line") for name in HOSTS]
    plant.file.write_text(PLANT.replace("timeout_ms: 500", "timeout_ms: 700"))
    done = subprocess.run(
        [*plant.control.prefix, sys.executable, "-m", "eap", "apply", str(plant.file)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "EAP_RUNTIME_DIR": str(plant.folder / "run")},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "4 stations changed" in done.stdout
    code, text, recap = plant.play()
    assert code == 0, text
    assert [each["changed"] for each in recap.values()] == [1, 1], text
    assert pids == [plant.hosts[name].run("systemctl show -P MainPID eap@line") for name in HOSTS]


def test_faulty_plant_stops_at_the_first_host(plant: Plant) -> None:
    bus = plant.folder / "drive.yaml"
    shutil.copyfile(ROOT / "config/buses/drive.yaml", bus)
    good = plant.file.read_text()
    port = '{name: bus0, kind: bus, interface: "sim://drive.yaml", net_id: 10.77.0.1.3.1}'
    plant.file.write_text(
        good.replace("net_id: 10.77.0.1.2.1}]", f"net_id: 10.77.0.1.2.1}}, {port}]")
    )
    # The bus file is not named in eap_files, so the host does not have it.
    code, text, recap = plant.play()
    assert code != 0
    assert "drive.yaml does not exist" in text
    assert recap["cell-a"]["failed"] == 1
    assert "cell-b" not in recap or recap["cell-b"]["changed"] == 0
    for name in HOSTS:
        assert plant.hosts[name].run("cat /etc/eap/line.yaml") == good
        assert all(pd["state"] == "running" for pd in plant.received(name).values())
    code, text, _ = plant.play("-e", '{"eap_files": ["drive.yaml"]}')
    assert code == 0, text
    wait_until(lambda: plant.hosts["cell-a"].attempt("eapctl bus scan oven/bus0").returncode == 0)
