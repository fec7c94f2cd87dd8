"""Missing rights, files or programs: one line, exit code 2, nothing half-started."""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from eap.codec.ethercat import EAP_PORT
from tests.support.appliance import Plants
from tests.support.namespaces import namespace

pytestmark = pytest.mark.net
IS_ABOUT_PROCESSES = True

ADDRESS = "127.9.6.2"
PLANT = """\
plant: refused
stations:
  - name: first
    net_id: 127.9.6.1.1.1
    ports: [{name: eap0, kind: eap, interface: "udp://127.9.6.1", net_id: 127.9.6.1.2.1}]
  - name: second
    net_id: 127.9.6.2.1.1
    ports: [{name: eap0, kind: eap, interface: "INTERFACE", net_id: 127.9.6.2.2.1}]
"""
UDP = f"udp://{ADDRESS}"


def refusal(farm: Plants, interface: str, *, prefix: Sequence[str] = ()) -> str:
    """Return the one line with which a start is refused; nothing of it may be left."""
    plant = farm.write(PLANT.replace("INTERFACE", interface), "refused.yaml")
    appliance = farm.start(plant, prefix=prefix)
    code, out, err = appliance.finish()
    assert (code, out) == (2, "")
    (line,) = err.splitlines()
    assert "Traceback" not in line
    assert list(appliance.runtime.iterdir()) == []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.9.6.1", EAP_PORT))
    return line


@pytest.mark.parametrize("kind", [socket.SOCK_DGRAM, socket.SOCK_STREAM], ids=["udp", "tcp"])
def test_a_port_held_by_a_foreign_process(farm: Plants, kind: int) -> None:
    with socket.socket(socket.AF_INET, kind) as squatter:
        squatter.bind((ADDRESS, EAP_PORT))
        if kind == socket.SOCK_STREAM:
            squatter.listen()
        line = refusal(farm, UDP)
    assert f"{ADDRESS}:{EAP_PORT} is in use" in line
    assert f"process {os.getpid()}" in line


@pytest.mark.parametrize("kind", [socket.SOCK_DGRAM, socket.SOCK_STREAM], ids=["udp", "tcp"])
def test_a_port_that_the_kernel_gave_to_a_client(farm: Plants, kind: int) -> None:
    with socket.create_server((ADDRESS, 0)) as server, socket.socket(type=kind) as client:
        client.bind((ADDRESS, EAP_PORT))
        client.connect(server.getsockname())
        line = refusal(farm, UDP)
    assert f"process {os.getpid()}" in line
    assert "net.ipv4.ip_local_reserved_ports" in line


def test_a_port_held_by_a_second_appliance(farm: Plants) -> None:
    other = farm.write(PLANT.replace("plant: refused", "plant: other").replace("INTERFACE", UDP))
    running = farm.run(other, "--station", "second")
    line = refusal(farm, UDP)
    assert f"{ADDRESS}:{EAP_PORT} is in use" in line
    assert "stop that appliance" in line
    assert running.process.poll() is None
    assert running.station("second")["state"] == "OP"
    assert running.stop()[0] == 0


def test_an_address_of_another_machine(farm: Plants) -> None:
    assert "192.0.2.1 is not an address of this machine" in refusal(farm, "udp://192.0.2.1")


@pytest.mark.root
def test_an_interface_that_is_missing_or_down(farm: Plants) -> None:
    with namespace() as here:
        missing = refusal(farm, "ethernet://eth7", prefix=here.prefix)
        assert "no interface 'eth7', expected one of lo" in missing
        here.ip("link", "add", "eth7", "type", "veth", "peer", "name", "eth8")
        down = refusal(farm, "ethernet://eth7", prefix=here.prefix)
        assert "eth7 is down" in down
        assert "ip link set eth7 up" in down


@pytest.mark.host_root
def test_raw_sockets_without_the_capability(farm: Plants) -> None:
    """An ordinary user made of root, who keeps only what it takes to read this tree."""
    farm.folder.chmod(0o755)
    keep = "+dac_override"
    ordinary = ["setpriv", "--reuid=65534", "--regid=65534", "--clear-groups"]
    ordinary += [f"--inh-caps={keep}", f"--ambient-caps={keep}"]
    line = refusal(farm, "ethernet://lo", prefix=ordinary)
    assert "CAP_NET_RAW" in line
    assert "setpriv" in line
    assert "--ambient-caps=+net_raw" in line
    assert sys.executable in line
    assert "udp://" in line
    assert "setcap" not in line


@pytest.mark.root
def test_root_without_the_capability(farm: Plants) -> None:
    line = refusal(farm, "ethernet://lo", prefix=["setpriv", "--bounding-set=-net_raw"])
    assert "CAP_NET_RAW" in line
    assert "root lacks it here" in line


def test_a_wrong_plant_file(farm: Plants) -> None:
    plant = farm.write(PLANT.replace("INTERFACE", UDP).replace("net_id: 127.9.6.1.1.1", "net: 1"))
    appliance = farm.start(plant)
    code, out, err = appliance.finish()
    assert (code, out) == (2, "")
    assert f"{plant}:4: " in err
    assert "net_id" in err
    assert not appliance.runtime.exists()


def test_no_plant_file_and_no_such_station(farm: Plants) -> None:
    code, out, err = farm.start(farm.folder / "absent.yaml").finish()
    assert (code, out) == (2, "")
    assert "absent.yaml" in err
    plant = farm.write(PLANT.replace("INTERFACE", UDP))
    code, out, err = farm.start(plant, "--station", "secund").finish()
    assert (code, out) == (2, "")
    assert "did you mean second?" in err
    assert not Path(farm.folder / "run2").exists()
