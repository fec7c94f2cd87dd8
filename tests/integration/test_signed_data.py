"""Signed process data between appliances: keys that change, forged and repeated frames, docs."""

from __future__ import annotations

import os
import signal
import socket
from pathlib import Path

import pytest

from eap.config.pd_keys import read_keys
from eap.pd.authentication import SIGNATURE_ID, SIGNATURE_SIZE, KeyRing
from eap.pd.link import OutFrame
from tests.support.appliance import Plants, run_eapctl, wait_until
from tests.support.cyclic import octets

pytestmark = pytest.mark.net

OVEN, PANEL = "127.9.96.1", "127.9.96.2"
PLANT = f"""\
plant: signed
defaults: {{cycle_us: 10000, pd_keys: NAME.keys}}
stations:
  - name: oven
    net_id: {OVEN}.1.1
    ports: [{{name: eap0, kind: eap, interface: "udp://{OVEN}", net_id: {OVEN}.2.1}}]
    variables: {{ticks: UDINT}}
    sources: {{ticks: {{kind: counter}}}}
    frames: [{{name: out, port: eap0, to: panel/eap0, sign: true}}]
    publish: [{{name: state, frame: out, id: 1, variables: [ticks]}}]
  - name: panel
    net_id: {PANEL}.1.1
    ports: [{{name: eap0, kind: eap, interface: "udp://{PANEL}", net_id: {PANEL}.2.1}}]
    subscribe:
      - {{name: state, port: eap0, from: oven/state, timeout_ms: 2000, auth: required}}
"""
FAULTS = ("unsigned", "bad_tag", "replayed")


class Pair:
    """The two appliances, each with its own copy of the keys."""

    def __init__(self, farm: Plants) -> None:
        self.folder = farm.folder
        self.eapctl("keys", "new", "oven.keys")
        self.copy()
        self.files = {}
        for name in ("oven", "panel"):
            self.files[name] = farm.write(PLANT.replace("NAME", name), f"{name}.yaml")
        self.oven = farm.start(self.files["oven"], "--station", "oven")
        self.panel = farm.start(self.files["panel"], "--station", "panel")
        for each in (self.oven, self.panel):
            each.wait_ready()

    def eapctl(self, *words: str) -> str:
        words = tuple(str(self.folder / w) if w.endswith(".keys") else w for w in words)
        done = run_eapctl(self.folder, *words)
        assert done.returncode == 0, done.stderr
        return done.stdout

    def copy(self) -> None:
        """Copy the keys of the oven to the panel."""
        target = self.folder / "panel.keys"
        target.touch(0o600)
        target.write_bytes((self.folder / "oven.keys").read_bytes())

    def faults(self) -> dict[str, int]:
        discarded = self.panel.rx("panel", "state")["discarded"]
        return {why: discarded.get(why, 0) for why in FAULTS}

    def receive(self, frames: int = 20) -> dict[str, int]:
        """Return the faults counted until so many more frames have been taken."""
        before, received = self.faults(), self.panel.rx("panel", "state")["received"]
        wait_until(lambda: self.panel.rx("panel", "state")["received"] >= received + frames)
        return {why: count - before[why] for why, count in self.faults().items()}


@pytest.fixture(scope="module")
def shared(module_farm: Plants) -> Pair:
    return Pair(module_farm)


@pytest.fixture
def pair(shared: Pair) -> Pair:
    shared.receive(1)
    return shared


def test_signed_data_arrives_and_nothing_is_counted(pair: Pair) -> None:
    assert pair.receive() == dict.fromkeys(FAULTS, 0)
    assert pair.oven.station("oven")["signing_key"] == 1


def test_forged_changed_and_repeated_frames_are_refused_and_named(pair: Pair) -> None:
    plain = octets([(1, b"\xff" * 4)], publisher=f"{OVEN}.2.1")
    blank = octets(
        [(1, b"\xff" * 4), (SIGNATURE_ID, bytes(SIGNATURE_SIZE), 1)], publisher=f"{OVEN}.2.1"
    )
    frame = OutFrame(bytearray(blank), 0, "", len(blank) - SIGNATURE_SIZE)
    KeyRing(read_keys(pair.folder / "oven.keys")).sign(frame, 1)  # as it was in 1970
    changed = bytearray(frame.buffer)
    changed[20] ^= 1
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind((OVEN, 0))
        for data in (plain, changed, frame.buffer):
            sock.sendto(data, (PANEL, 34980))
    wait_until(lambda: pair.faults() == dict.fromkeys(FAULTS, 1))
    pair.receive()
    assert pair.panel.values("panel")["state.ticks"] < 0xFFFFFFFF
    report = run_eapctl(pair.panel.runtime, "status", "--full").stdout
    assert "not authentic: 1 unsigned, 1 bad tag, 1 replayed" in report
    assert "PD 65534: signature by key 1, made 1970-01-01" in pair.eapctl(
        "decode", frame.buffer.hex()
    )


def test_keys_change_while_data_flows(pair: Pair) -> None:
    assert pair.receive() == dict.fromkeys(FAULTS, 0)
    pair.eapctl("keys", "new", "oven.keys")
    pair.copy()
    pair.receive(200)
    pair.eapctl("keys", "use", "oven.keys", "2")
    wait_until(lambda: pair.oven.station("oven")["signing_key"] == 2)
    assert pair.receive() == dict.fromkeys(FAULTS, 0)
    pair.copy()
    pair.eapctl("keys", "remove", "oven.keys", "1")
    pair.copy()
    assert pair.receive(200) == dict.fromkeys(FAULTS, 0)


def test_killed_engines_go_on_with_their_counters(pair: Pair) -> None:
    for each in (pair.oven, pair.panel):
        os.kill(each.pid("engine"), signal.SIGKILL)
    wait_until(lambda: pair.panel.station("panel")["restarts"] >= 1)
    faults = pair.receive()
    assert faults == dict.fromkeys(FAULTS, 0)


@pytest.mark.parametrize(
    ("content", "mode", "reason"),
    [
        (None, 0o600, "No such file"),
        ("", 0o600, "no key in it"),
        ("1 " + "00" * 32, 0o644, "others may read its keys: chmod 600"),
        ("1 abc", 0o600, "line 1: no number and 64 hexadecimal digits"),
    ],
)
def test_check_names_what_is_wrong_with_keys(
    farm: Plants, content: str | None, mode: int, reason: str
) -> None:
    file = farm.write(PLANT.replace("NAME", "bad"), "bad.yaml")
    if content is not None:
        keys: Path = file.with_name("bad.keys")
        keys.write_text(content)
        keys.chmod(mode)
    done = run_eapctl(farm.folder, "check", str(file))
    assert done.returncode == 2
    assert f"bad.yaml:2: {file.with_name('bad.keys')}: {reason}" in done.stdout + done.stderr
