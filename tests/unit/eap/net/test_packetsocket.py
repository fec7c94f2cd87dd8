"""Opening AF_PACKET sockets: what goes wrong, and what the message says about it."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys

import pytest

from eap.errors import EnvironmentalError
from eap.net.packetsocket import missing_capability, open_packet_pair, open_type1
from tests.unit.eap.net.conftest import ip

pytestmark = pytest.mark.net

AS_NOBODY = """
import os
from eap.net.packetsocket import open_packet_pair
from eap.errors import EnvironmentalError
os.setgroups([])
os.setresgid(65534, 65534, 65534)
os.setresuid(65534, 65534, 65534)
try:
    open_packet_pair("lo")
except EnvironmentalError as error:
    print(error)
"""


def test_missing_interface_is_named_with_those_that_exist():
    with pytest.raises(EnvironmentalError, match=r"no interface 'eth77', expected one of .*\blo\b"):
        open_packet_pair("eth77")


@pytest.mark.root
def test_interface_that_is_down_is_named_with_the_cure(cable):
    ip("link set left down")
    with pytest.raises(EnvironmentalError, match="left is down: `ip link set left up`"):
        open_packet_pair("left")


@pytest.mark.root
def test_interface_without_a_cable_can_be_opened(cable):
    ip("link set right down")
    for sock in open_packet_pair("left"):
        sock.close()


@pytest.mark.root
def test_bus_gets_frames_of_type_1_and_no_others(cable):
    with open_type1("left") as deaf, open_type1("right") as sender:
        for kind in (4, 1, 5):
            sender.send(bytes(12) + b"\x88\xa4" + bytes((0, kind << 4)) + bytes(46))
        deaf.settimeout(5)
        assert deaf.recv(100)[15] == 0x10
        deaf.setblocking(False)
        with pytest.raises(BlockingIOError):
            deaf.recv(100)


@pytest.mark.host_root
@pytest.mark.root
@pytest.mark.parametrize("opener", [open_packet_pair, open_type1])
def test_interface_of_another_kind_is_refused(cable, opener):
    ip("tuntap add dev tunnel mode tun")
    ip("link set tunnel up")
    with pytest.raises(EnvironmentalError, match="tunnel is not an Ethernet interface"):
        opener("tunnel")


@pytest.mark.host_root
def test_missing_capability_names_working_command():
    done = subprocess.run(
        [sys.executable, "-c", AS_NOBODY], capture_output=True, text=True, check=True
    )
    message = done.stdout.strip()
    assert "\n" not in re.sub(r"'[^']*'", "", message)  # but for the script in its own quotes
    assert message.startswith("ethernet://lo needs the capability CAP_NET_RAW; grant it to this")
    assert "udp://" in message
    assert "setcap" not in message
    command = shlex.split(re.search(r"`(setpriv .*)`", message, re.DOTALL)[1])
    prefix = command[: command.index(sys.executable)]
    status = subprocess.run(
        [*prefix, "cat", "/proc/self/status"], capture_output=True, text=True, check=True
    ).stdout
    assert re.search(r"^Uid:\s+65534\b", status, re.MULTILINE)
    assert re.search(r"^CapEff:\s+0000000000002000$", status, re.MULTILINE)


@pytest.mark.parametrize(("uid", "cure"), [(0, "--cap-add=NET_RAW"), (1000, "--reuid=1000 ")])
def test_refusal_of_the_kernel_becomes_one_message(monkeypatch, uid, cure):
    def refuse(*_):
        raise PermissionError

    monkeypatch.setattr("socket.socket", refuse)
    monkeypatch.setattr("eap.net.packetsocket.check_interface", lambda _: None)
    monkeypatch.setattr("os.geteuid", lambda: uid)
    monkeypatch.setattr("os.getuid", lambda: uid)
    with pytest.raises(EnvironmentalError) as caught:
        open_packet_pair("eth0")
    assert cure in str(caught.value)
    assert str(caught.value) == missing_capability("eth0")
