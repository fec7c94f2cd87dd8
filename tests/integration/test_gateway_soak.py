"""Random requests against a running gateway: no crash, no leak, no slave that is stuck afterwards.

``EAP_LONG=1`` sends a million.
"""

from __future__ import annotations

import os
import random
import select
import struct
from contextlib import suppress
from pathlib import Path

import pytest

from tests.support.appliance import Appliance, wait_until
from tests.support.gatewayplant import DRIVE, FILE, LAST, SENSOR, gateway_plant
from tests.support.gatewaywire import COE, FOE, SOE, VENDOR, Wire, frame, wire
from tests.support.vectors import load

pytestmark = pytest.mark.net

HOST = "127.9.86.4"
REQUESTS = 1_000_000 if os.environ.get("EAP_LONG") else 4000
BATCH = 8
"""Requests of one client on their way."""
GROWTH_KIB = 30_000
"""By which services may be larger afterwards: clients, sessions and counters up to their limits."""
ADDRESSES = (0, 0, DRIVE, DRIVE, SENSOR, LAST, 1002, 1777, DRIVE | 0x8000, 0xFFFF, 0x4242)
SAFE = frozenset((0x6040, 0xA000, 0xA001, 0xA002, 0xA003, 0xA004, 0xF002, 0xF200))
"""Objects that are not written by chance: they bring slaves to other states."""
BODIES = {
    COE: ("0020401810010000 0000", "00205018100000000000", "00204008100000000000",
          "0020400180000000 0000", "0020600000000000 0000", "0020700000000000 0000",
          "008001000000 0100", "008003000000 1810", "008005000000 181001 7f",
          "0020210180000008 0000" + "55" * 100, "0020000102030405060708", "00208001800000000008"),
    SOE: ("0140 2000", "0106 2000", "01ff 2400", "0340 2000 02000000", "4140 2000", "0b40 0200 00"),
    FOE: ("0100 00000000" + b"firmware.bin".hex(), "0400 01000000", "0400 02000000",
          "0200 00000000" + b"parameters.bin".hex(), "0300 01000000" + "66" * 90, "0500 00800000"),
    15: ("64110000 0100 0102",),
    2: ("06000000", "00000000" + "00" * 60, "0200 0000"),
    1: ("00" * 32, "7f000001030 1e903".replace(" ", "") + "00" * 24),
    0: ("0100 0200",),
}  # fmt: skip


def soak_frames(dice: random.Random) -> bytes:
    """Return the next frame: a request, one of the vectors, or either of them damaged."""
    choice = dice.random()
    if choice < 0.15:
        octets = dice.choice(VECTORS)
    else:
        kind = dice.choice((*BODIES, COE, COE, FOE))
        body = bytes.fromhex(dice.choice(BODIES[kind]))
        octets = frame(kind, dice.choice(ADDRESSES), body, dice.randrange(8))
    if dice.random() < 0.25:
        octets = _damaged(octets, dice)
    return b"" if _is_dangerous(octets) else octets


def _damaged(octets: bytes, dice: random.Random) -> bytes:
    changed = bytearray(octets)
    for _ in range(dice.randrange(1, 4)):
        changed[dice.randrange(len(changed))] = dice.randrange(256)
    cut = dice.choice((len(changed), len(changed), dice.randrange(len(changed) + 1)))
    return bytes(changed[:cut]) + dice.randbytes(dice.choice((0, 0, 0, 40)))


def _is_dangerous(octets: bytes) -> bool:
    """Say whether a frame may change states, or go where AoE routes lead."""
    places = {struct.unpack_from("<H", octets, at)[0] for at in range(8, min(16, len(octets) - 1))}
    return bool(places & SAFE)


VECTORS = [each.octets for stem in ("type5_gateway", "high_nibble_dialect") for each in load(stem)]


class Crowd:
    """Clients one after the other, each from another address, a third of them by TCP.

    Attributes:
        sent: Requests.
        answers: Datagrams that came back, and pieces of streams.
    """

    def __init__(self, dice: random.Random) -> None:
        self.sent = self.answers = 0
        self._dice = dice

    def send_client(self) -> None:
        """Be a client; one by TCP is sent away at what is no frame, and some never read."""
        is_stream = self._dice.random() < 1 / 3
        is_deaf = is_stream and self._dice.random() < 1 / 5
        with wire(HOST, tcp=is_stream) as client, suppress(ConnectionError):
            for _ in range(25):
                self._send_batch(client)
                if not is_deaf:
                    self._take_answers(client)

    def _send_batch(self, client: Wire) -> None:
        for _ in range(BATCH):
            octets = soak_frames(self._dice)
            if octets:
                client.send(octets)
                self.sent += 1

    def _take_answers(self, client: Wire) -> None:
        while select.select([client.sock], [], [], 0.004)[0]:
            if not client.sock.recv(4096) and client.is_stream:
                raise ConnectionError("it has closed the connection")
            self.answers += 1


def memory_kib(appliance: Appliance) -> int:
    lines = Path(f"/proc/{appliance.pid('services')}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS"))


@pytest.mark.timeout(REQUESTS // 200 + 120)
def test_station_works_after_all_bad_input() -> None:
    with gateway_plant(HOST) as appliance:
        pids = [appliance.pid(name) for name in ("engine", "services", "supervisor")]
        before, crowd = 0, Crowd(random.Random(86))
        while crowd.sent < REQUESTS:
            crowd.send_client()
            if not before and crowd.sent >= REQUESTS // 4:
                before = memory_kib(appliance)
        assert crowd.answers > crowd.sent // 4
        _check_slaves()
        assert [appliance.pid(name) for name in ("engine", "services", "supervisor")] == pids
        assert memory_kib(appliance) < before + GROWTH_KIB


def _check_slaves() -> None:
    """See that nobody is stuck, at the latest when transfers that others left have timed out."""
    identity = bytes.fromhex("0030 43 1810 01 5a0e0000")
    expected = {
        **{(COE, station, VENDOR): identity for station in (DRIVE, SENSOR, LAST)},
        (COE, 0, VENDOR): bytes.fromhex("0030 43 1810 01"),
        (SOE, DRIVE, bytes.fromhex("01 40 2000")): bytes.fromhex("02 40 2000"),
        (FOE, DRIVE, bytes.fromhex("01 00 00000000") + b"firmware.bin"): (
            bytes.fromhex("03 00 01000000") + FILE
        ),
    }
    with wire(HOST) as client:
        for (kind, address, body), answer in expected.items():

            def is_answered(asked=(kind, address, body), answer=answer) -> bool:
                return client.talk(*asked)[1].startswith(answer)

            wait_until(is_answered, 7)
