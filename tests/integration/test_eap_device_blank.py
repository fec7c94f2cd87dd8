"""A station without a configuration, configured by AoE alone."""

from __future__ import annotations

import os
import signal
import socket

import pytest

from eap.od.profiles.eap1000 import AddressMode, FrameSub, Rx, RxFlag, Tx, Var
from tests.integration.test_eap_device import (
    BLANK,
    LEFT,
    OP,
    PLANT,
    RIGHT,
    bring,
    is_free,
    wait_free,
)
from tests.support import aoe
from tests.support.aoe import UdpClient
from tests.support.appliance import Plants, troubles, wait_until

pytestmark = pytest.mark.net


class Downloads:
    """A station's configuration as SDO downloads, one after the other."""

    def __init__(self, client: UdpClient) -> None:
        self.client = client

    def __call__(self, index: int, subindex: int, value: int | str | bytes, size: int = 2) -> None:
        if isinstance(value, str):
            octets = value.encode()
        else:
            octets = value if isinstance(value, bytes) else value.to_bytes(size, "little")
        answer = self.client.write(index, subindex, octets)
        assert (answer.error, answer.result) == (0, 0), f"0x{index:04X}:{subindex:02X}"


def configure_blank(put: Downloads) -> None:
    """Have the blank station send a counter to the right one, and take what the left one sends."""
    put(0x6000, Var.TYPE_NAME, "UDINT")
    put(0x6000, Var.NAME, "answer")
    put(0x6000, Var.DEFAULT_GIVEN, b"\1")
    put(0x6000, Var.DEFAULT, 42, 4)
    put(0x1A00, 1, 0x6000_0120, 4)
    put(0x1A00, 0, 1, 1)
    put(0xD000, Tx.PDO_INDEX, 0x1A00)
    put(0xD000, Tx.PD_ID, 9)
    put(0xD000, Tx.ENABLED, b"\1")
    put(0xD000, Tx.CYCLE_TIME, 10_000, 4)
    put(0x8000, FrameSub.ADDRESS_MODE, int(AddressMode.IP), 1)
    put(0x8000, FrameSub.DESTINATION_IP, socket.inet_aton(RIGHT))
    put(0x8000, FrameSub.TXPD, 0xD000)
    put(0x8000, FrameSub.ENABLED, b"\1")
    for number, (name, kind) in enumerate((("ticks", "UDINT"), ("setpoint", "UINT"))):
        put(0x7000 + number, Var.TYPE_NAME, kind)
        put(0x7000 + number, Var.NAME, name)
    put(0x1600, 1, 0x7000_0120, 4)
    put(0x1600, 2, 0x7001_0110, 4)
    put(0x1600, 0, 2, 1)
    put(0xE000, Rx.PDO_INDEX, 0x1600)
    put(0xE000, Rx.PD_ID, 1)
    put(0xE000, Rx.PUBLISHER, aoe.net_id(f"{LEFT}.2.1"))
    put(0xE000, Rx.FLAGS, int(RxFlag.ENABLED), 1)
    put(0xE000, Rx.STEP, 1, 4)


MEETS_BLANK = PLANT.replace("to: right/eap0", f"to: {BLANK}").replace(
    "      - {name: left-state, port: eap0, from: left/state}\n",
    f"      - {{name: of-blank, port: eap0, from: {{publisher: {BLANK}.2.1, id: 9}}, foreign: true,"
    " variables: {seen: UDINT}}\n",
)


def test_blank_station_configured_by_aoe_alone_exchanges_data_with_one_of_a_plant_file(
    farm: Plants,
) -> None:
    """Also after its services were killed between the downloads and SafeOp, and all of it in Op."""
    wait_free(LEFT, RIGHT, BLANK)
    words = ("--blank", "blank", "--interface", f"udp://{BLANK}", "--net-id", f"{BLANK}.2.1")
    known = farm.run(farm.write(MEETS_BLANK))
    blank = farm.start(None, *words)
    assert blank.wait_ready() == ["blank"]
    assert blank.station("blank")["state"] == "PREOP"
    with UdpClient(BLANK, f"{BLANK}.2.1", source="127.0.0.1") as client:
        configure_blank(Downloads(client))
        services = blank.pid("services")
        os.kill(services, signal.SIGKILL)
        blank.wait_for_another("services", services)
        wait_until(lambda: bring(client, OP).result == 0)
        assert client.read(0xF100, 1).data == b"\x08\0"
    wait_until(lambda: known.values("right")["seen"] == 42)
    wait_until(lambda: blank.values("blank")["setpoint"] == 900)
    before = blank.values("blank")["ticks"]
    wait_until(lambda: blank.values("blank")["ticks"] > before + 10)
    (name,) = [rx["name"] for rx in blank.station("blank")["pd"]["rx"]]
    assert troubles(blank.rx("blank", name)) == (0, 0, 0)

    blank.process.kill()
    blank.finish()
    wait_until(lambda: is_free(BLANK))
    again = farm.start(None, *words, "--resume")
    again.wait_ready()
    assert again.station("blank")["state"] == "OP"
    wait_until(lambda: again.values("blank")["setpoint"] == 900)
    again.command("pd", "set", "blank", "answer", "43")
    wait_until(lambda: known.values("right")["seen"] == 43)
