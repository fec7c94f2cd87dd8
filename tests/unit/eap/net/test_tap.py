"""TAP interface, with the kernel of this machine."""

from __future__ import annotations

import os
import select
import socket
import subprocess
import sys
from ipaddress import IPv4Interface
from pathlib import Path

import pytest

from eap.errors import EnvironmentalError
from eap.net import tap
from eap.net.tap import TapPort

pytestmark = [pytest.mark.net, pytest.mark.root]

NAME = "taptest0"
ADDRESS = IPv4Interface("10.77.1.1/24")


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True)


@pytest.fixture(autouse=True)
def _device():
    try:
        os.close(os.open("/dev/net/tun", os.O_RDWR))
    except OSError:
        pytest.skip("needs /dev/net/tun: load the kernel module tun")


def read(port: TapPort, kind: bytes) -> bytes:
    """Return the next frame of the host with an EtherType."""
    while True:
        assert select.select([port], [], [], 10)[0]
        for frame in port.read_frames():
            if frame[12:14] == kind:
                return frame


def test_tap_carries_frames_both_ways():
    port = TapPort(NAME, ADDRESS)
    try:
        assert port.is_up()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            sock.sendto(b"?", ("10.77.1.2", 9))
            question = read(port, b"\x08\x06")
            assert question[38:42] == socket.inet_aton("10.77.1.2")
            mac = bytes.fromhex("020000000002")
            head = question[6:12] + mac + question[12:20] + b"\0\2"
            port.write_frame(head + mac + question[38:42] + question[22:32])
            frame = read(port, b"\x08\x00")
            assert (frame[:6], frame[-1:]) == (mac, b"?")
        assert port.dropped == 0
    finally:
        port.close()
    assert NAME not in {name for _, name in socket.if_nameindex()}


def test_open_interface_is_refused_to_others_with_the_reason():
    port = TapPort(NAME)
    try:
        with pytest.raises(EnvironmentalError, match=f"{NAME}: it is open already"):
            TapPort(NAME)
    finally:
        port.close()
    with pytest.raises(EnvironmentalError, match="exists and is no TAP interface"):
        TapPort("lo")


def test_interface_that_is_deleted_or_down_is_noticed():
    port = TapPort(NAME)
    try:
        ip("link", "set", NAME, "down")
        assert not port.is_up()
        port.write_frame(bytes(60))
        assert port.dropped == 1
        ip("link", "delete", NAME)
        assert not port.is_up()
        with pytest.raises(OSError, match="bad state"):
            list(port.read_frames())
    finally:
        port.close()


def test_prepared_interface_keeps_what_the_administrator_has_set():
    ip("tuntap", "add", "dev", NAME, "mode", "tap")
    try:
        ip("addr", "add", str(ADDRESS), "dev", NAME)
        port = TapPort(NAME)
        port.close()
        shown = subprocess.run(
            ["ip", "addr", "show", NAME], capture_output=True, text=True, check=True
        )
        assert str(ADDRESS) in shown.stdout
    finally:
        ip("link", "delete", NAME)


def test_missing_device_is_named(monkeypatch, tmp_path):
    monkeypatch.setattr(tap, "_DEVICE", str(tmp_path / "tun"))
    with pytest.raises(EnvironmentalError, match="load the kernel module tun"):
        TapPort(NAME)


UID = 64_952
OPEN = """
import sys
from eap.errors import EnvironmentalError
from eap.net.tap import TapPort
try:
    port = TapPort(sys.argv[1])
except EnvironmentalError as exc:
    print(exc)
else:
    print("open", port.is_up())
"""


def open_as_user() -> str:
    """Return what an ordinary user is told."""
    if not Path("/dev/net/tun").stat().st_mode & 0o002:
        pytest.skip("needs /dev/net/tun for every user: chmod 666 /dev/net/tun")
    # Reading this tree is all that is kept of root.
    user = ["setpriv", f"--reuid={UID}", f"--regid={UID}", "--clear-groups"]
    user += ["--inh-caps=+dac_read_search", "--ambient-caps=+dac_read_search"]
    words = [*user, sys.executable, "-c", OPEN, NAME]
    return subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip()


@pytest.mark.host_root
def test_ordinary_user_is_told_how_to_prepare_an_interface():
    assert open_as_user() == (
        f"TAP interface {NAME}: not permitted: give this program CAP_NET_ADMIN, or prepare the"
        f" interface as root: `ip tuntap add dev {NAME} mode tap user {UID}`,"
        f" `ip link set {NAME} up`"
    )


@pytest.mark.host_root
def test_ordinary_user_opens_an_interface_that_was_prepared():
    ip("tuntap", "add", "dev", NAME, "mode", "tap", "user", str(UID))
    try:
        assert open_as_user() == (
            f"TAP interface {NAME} is down: `ip link set {NAME} up` as root switches it on"
        )
        ip("link", "set", NAME, "up")
        assert open_as_user() == "open True"
    finally:
        ip("link", "delete", NAME)
