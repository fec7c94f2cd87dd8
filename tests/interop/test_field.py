"""Bridges to controllers: snap7 and jsmodbus as controllers, nodes7 and jsmodbus as clients."""

from __future__ import annotations

import json
import logging
import socket
import struct
import subprocess
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from math import nan
from pathlib import Path
from typing import Any

import pytest

from tests.support.appliance import Appliance, Plants, plants
from tests.support.eventually import wait_until
from tests.support.npm import needs_npm, node_environment

pytestmark = [pytest.mark.net, needs_npm("nodes7", "jsmodbus")]

PLANT = """\
plant: field
s7:
  controllers:
    press: {host: 127.9.80.2, port: 1102, every_ms: 20, timeout_ms: 300, substitute: default}
  server:
    listen: 127.9.80.1:2102
    every_ms: 20
    blocks:
      1: [mill/temp, mill/count, {of: mill/setpoint, write: true}, {of: mill/on, write: true},
          mill/running, {of: mill/name, write: true}]
      2: [{of: mill/locked, write: true}]
modbus:
  controllers:
    meter: {host: 127.9.80.2, port: 1502, every_ms: 20, timeout_ms: 300, word_order: little}
  server:
    listen: 127.9.80.1:2502
    every_ms: 20
    unit: 3
    holding: [{of: mill/setpoint, write: true}, mill/temp, {of: mill/level, write: true}]
    input: [mill/count]
    coil: [{of: mill/on, write: true}, {of: mill/locked, write: true}]
    discrete: [mill/running]
stations:
  - name: mill
    net_id: 127.9.80.1.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://127.9.80.1", net_id: 127.9.80.1.2.1}
    variables:
      temp: {type: REAL, default: -1}
      count: UDINT
      running: BOOL
      outside: INT
      stamp: LDT
      text: STRING(8)
      setpoint: REAL
      level: UINT
      on: BOOL
      locked: BOOL
      name: STRING(6)
      power: REAL
      flag: BOOL
    sources:
      temp: {kind: s7, controller: press, address: DB1.DBD4}
      running: {kind: s7, controller: press, address: DB1.DBX0.3}
      stamp: {kind: s7, controller: press, address: DB1.DBB10, type: DTL}
      text: {kind: s7, controller: press, address: DB1.DBB22}
      outside: {kind: s7, controller: press, address: DB9.DBW0}
      count: {kind: counter}
      power: {kind: modbus, controller: meter, address: "holding:10"}
      flag: {kind: modbus, controller: meter, address: "coil:1"}
    targets:
      setpoint: {kind: s7, controller: press, address: DB2.DBD0}
      on: {kind: modbus, controller: meter, address: "coil:5"}
      level: {kind: modbus, controller: meter, address: "holding:20", type: UDINT}
    frames: [{name: out, port: eap0, to: 127.9.80.3}]
    publish: [{name: state, frame: out, id: 1, variables: [temp, press.ok]}]
    access:
      - {name: kiosk, deny: [write], from: [127.9.80.9], transports: [s7, modbus]}
"""

METER = """
const Modbus = require('jsmodbus'), net = require('net');
const server = new net.Server(), holding = Buffer.alloc(200), coils = Buffer.alloc(20);
holding.writeUInt16BE(0x0000, 20); holding.writeUInt16BE(0x4050, 22); coils[0] = 2;
const peer = new Modbus.server.TCP(server, {holding, coils, discrete: coils, input: holding});
peer.on('postWriteMultipleRegisters', () => console.log(holding.toString('hex', 40, 44)));
peer.on('postWriteSingleCoil', () => console.log('coil', coils[0]));
server.listen(1502, '127.9.80.2', () => console.log('listening'));
"""


class Press:
    """The server of snap7 as the controller ``press``."""

    def __init__(self) -> None:
        self.db1, self.db2 = bytearray(64), bytearray(16)
        struct.pack_into(">f", self.db1, 4, 21.5)
        self.db1[0] = 8
        stamp = 2026, 12, 24, 5, 20, 30, 15, 250_000_000
        struct.pack_into(">HBBBBBBI", self.db1, 10, *stamp)
        self.db1[22:32] = b"\x08\x05h\xe9llo\0\0\0"
        self._server: Any = None

    def start(self) -> None:
        logging.getLogger("snap7").setLevel(logging.ERROR)
        from snap7.server import Server
        from snap7.type import SrvArea

        self._server = Server()
        self._server.register_area(SrvArea.DB, 1, self.db1)
        self._server.register_area(SrvArea.DB, 2, self.db2)
        self._server.start_to("127.9.80.2", 1102)

    def stop(self) -> None:
        self._server.stop()
        self._server.destroy()

    @property
    def setpoint(self) -> float:
        value: float = struct.unpack_from(">f", self.db2)[0]
        return value


@contextmanager
def meter() -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(
        ["node", "-e", METER], stdout=subprocess.PIPE, text=True, env=node_environment()
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "listening\n"
        try:
            yield process
        finally:
            process.kill()


@pytest.fixture(scope="module")
def press() -> Iterator[Press]:
    found = Press()
    found.start()
    yield found
    found.stop()


@pytest.fixture(scope="module")
def folder() -> Iterator[Plants]:
    with plants() as found:
        yield found


@pytest.fixture(scope="module")
def plant(folder: Plants, press: Press) -> Appliance:
    return folder.run(folder.write(PLANT))


def node(script: str) -> Any:
    """Return what a script prints, as JSON."""
    done = subprocess.run(
        ["node", "-e", textwrap.dedent(script)],
        capture_output=True, text=True, env=node_environment(), timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def peer(plant: Appliance, bridge: str) -> dict[str, Any]:
    found = plant.status()["processes"][bridge].get("bridge") or {"peers": ()}
    return next(iter(found["peers"]), {"is_up": None, "failed": 0, "connects": 0, "reason": ""})


def read(plant: Appliance, name: str) -> tuple[Any, int | None, bool]:
    found = plant.request("read", station="mill", names=[name])
    return found["values"][name], found["quality"].get(name), name in found["stale"]


def test_values_of_snap7_reach_the_station(plant: Appliance) -> None:
    wait_until(lambda: plant.values("mill")["temp"] == 21.5)
    values = plant.values("mill")
    assert values["running"] is True
    assert values["stamp"] == "LDT#2026-12-24-20:30:15.25"
    assert values["text"] == "héllo"
    value, quality, is_stale = read(plant, "temp")
    assert (value, is_stale) == (21.5, False)
    assert quality is not None
    # One value is outside of all blocks: it alone fails, and so the controller is not all right.
    wait_until(lambda: peer(plant, "s7")["failed"] == 1)
    found = peer(plant, "s7")
    assert (found["is_up"], found["values"]) == (True, 6)
    assert found["reason"].startswith("mill/outside: ")
    assert read(plant, "outside") == (0, None, True)
    assert values["press.ok"] is False
    wanted = f"1 of 6 values fail: {found['reason']}"
    assert wanted in {row["what"] for row in plant.status()["findings"]}


def test_number_that_is_none_reaches_the_station_beside_the_others(
    plant: Appliance, press: Press
) -> None:
    wait_until(lambda: plant.values("mill")["temp"] == 21.5)
    struct.pack_into(">f", press.db1, 4, nan)
    press.db1[0] = 0
    try:
        # JSON shows NaN as null.
        wait_until(lambda: plant.values("mill")["temp"] is None)
        wait_until(lambda: plant.values("mill")["running"] is False)
        assert read(plant, "temp")[2] is False
    finally:
        struct.pack_into(">f", press.db1, 4, 21.5)
        press.db1[0] = 8
    wait_until(lambda: plant.values("mill")["temp"] == 21.5)


def test_targets_reach_snap7_and_jsmodbus(plant: Appliance, press: Press) -> None:
    plant.request("write", station="mill", values={"setpoint": 2.5})
    wait_until(lambda: press.setpoint == 2.5)
    with meter() as process:
        assert process.stdout is not None
        wait_until(lambda: plant.values("mill")["power"] == 3.25)
        assert plant.values("mill")["flag"] is True
        assert plant.values("mill")["meter.ok"] is True
        plant.request("write", station="mill", values={"level": 40_001, "on": True})
        # Everything once after the connection, then what changed; word_order is little.
        wanted = {"9c410000\n", "coil 34\n"}
        while wanted:
            line = process.stdout.readline()
            assert line
            wanted.discard(line)
    wait_until(lambda: not peer(plant, "modbus")["is_up"])
    wait_until(lambda: plant.values("mill")["meter.ok"] is False)


def test_controller_that_is_away_for_seconds_is_substituted_and_comes_back(
    plant: Appliance, press: Press
) -> None:
    wait_until(lambda: plant.values("mill")["temp"] == 21.5)
    before = peer(plant, "s7")["connects"]
    press.stop()
    wait_until(lambda: read(plant, "temp")[2])
    wait_until(lambda: plant.values("mill")["temp"] == -1)
    wait_until(lambda: not peer(plant, "s7")["is_up"])
    assert peer(plant, "s7")["reason"]
    values = plant.values("mill")
    assert values["running"] is False
    assert values["press.age_ms"] >= 300
    (controller,) = [c for c in plant.station("mill")["controllers"] if c["name"] == "press"]
    assert (controller["sources"], controller["late"]) == (5, 5)
    # Set while it is away: it has the value as soon as it is back.
    plant.request("write", station="mill", values={"setpoint": 7.5})
    struct.pack_into(">f", press.db1, 4, 22.5)
    press.start()
    wait_until(lambda: plant.values("mill")["temp"] == 22.5)
    wait_until(lambda: press.setpoint == 7.5)
    wait_until(lambda: peer(plant, "s7")["connects"] > before)
    struct.pack_into(">f", press.db1, 4, 21.5)


def test_killed_bridge_is_late_and_comes_back(plant: Appliance) -> None:
    wait_until(lambda: plant.values("mill")["temp"] == 21.5)
    pid = plant.pid("s7")
    cycle = plant.station("mill")["cycle"]
    subprocess.run(["kill", "-9", str(pid)], check=True)
    wait_until(lambda: plant.values("mill")["temp"] == -1)
    wait_until(lambda: plant.values("mill")["temp"] == 21.5)
    assert plant.pid("s7") != pid
    assert plant.station("mill")["cycle"] > cycle


NODES7 = """
const S7 = require('nodes7'), c = new S7({silent: true});
const names = {temp: 'DB1,REAL0', setpoint: 'DB1,REAL8', on: 'DB1,X12.0', running: 'DB1,X12.1',
               name: 'DB1,S14.6', locked: 'DB2,X0.0', missing: 'DB5,INT0'};
c.initiateConnection({port: 2102, host: '127.9.80.1', rack: 0, slot: 1, timeout: 8000}, (error) => {
  if (error) { console.error(error); process.exit(1); }
  c.setTranslationCB((name) => names[name]);
  const out = {};
  c.addItems(['temp', 'running', 'setpoint', 'on', 'name']);
  c.readAllItems((bad, values) => {
    out.before = values;
    c.writeItems(['setpoint', 'on', 'name'], [4.5, true, 'hall'], (bad) => {
      out.bad = bad;
      c.readAllItems((bad, values) => {
        out.after = values;
        c.writeItems(['temp'], [1], (bad) => {
          out.denied = bad;
          c.addItems(['missing']);
          c.readAllItems((bad, values) => {
            out.missing = [bad, values.missing, values.setpoint];
            console.log(JSON.stringify(out));
            c.dropConnection(() => process.exit(0));
          });
        });
      });
    });
  });
});
"""


def test_nodes7_reads_and_writes_the_served_blocks(plant: Appliance) -> None:
    plant.request("write", station="mill", values={"setpoint": 1.5, "on": False, "name": ""})
    wait_until(lambda: plant.values("mill")["temp"] == 21.5)
    found = node(NODES7)
    assert found["before"] == {
        "temp": 21.5, "running": True, "setpoint": 1.5, "on": False, "name": "",
    }  # fmt: skip
    assert found["bad"] is False
    assert found["after"]["setpoint"] == 4.5
    assert (found["after"]["on"], found["after"]["name"]) == (True, "hall")
    # A value that clients must not write, and a block that is not there.
    assert found["denied"] is True
    assert found["missing"] == [True, "BAD 255", 4.5]
    values = plant.values("mill")
    assert (values["setpoint"], values["on"], values["name"]) == (4.5, True, "hall")
    audit = Path(plant.status()["audit"]["file"]).read_text().splitlines()
    lines = [json.loads(line) for line in audit if '"s7:127.0.0.1"' in line]
    assert {name for line in lines for name in line["asked"]["values"]} == {
        "setpoint",
        "on",
        "name",
    }
    assert {line["error"] for line in lines} == {""}


def test_snap7_reads_and_writes_the_served_blocks(plant: Appliance) -> None:
    from snap7.client import Client

    plant.request("write", station="mill", values={"setpoint": 1.5, "on": False})
    wait_until(lambda: plant.values("mill")["temp"] == 21.5)
    client = Client()
    client.connect("127.9.80.1", 0, 1, 2102)
    try:
        assert client.get_pdu_length() == 480
        # The server takes values every 20 ms.
        wait_until(lambda: struct.unpack_from(">fIf", client.db_read(1, 0, 22))[::2] == (21.5, 1.5))
        client.db_write(1, 8, bytearray(struct.pack(">f", 6.25)))
        wait_until(lambda: plant.values("mill")["setpoint"] == 6.25)
        with pytest.raises(Exception, match=r"denied|not allowed|Access"):
            client.db_write(1, 0, bytearray(4))
        with pytest.raises(Exception, match=r"exist|address"):
            client.db_read(7, 0, 4)
        assert client.get_connected()
    finally:
        client.disconnect()


JSMODBUS = """
const Modbus = require('jsmodbus'), net = require('net');
const socket = new net.Socket(), client = new Modbus.client.TCP(socket, 3, 5000);
const hex = (found) => found.response.body.valuesAsBuffer.toString('hex');
const bits = (found) => found.response.body.valuesAsArray.slice(0, 2);
socket.on('connect', async () => {
  const out = {};
  out.holding = hex(await client.readHoldingRegisters(0, 5));
  out.count = hex(await client.readInputRegisters(0, 2));
  out.coils = bits(await client.readCoils(0, 2));
  out.discrete = bits(await client.readDiscreteInputs(0, 1));
  await client.writeMultipleRegisters(0, [0x40b0, 0x0000]);
  await client.writeSingleRegister(4, 17);
  await client.writeSingleCoil(1, true);
  await client.writeMultipleCoils(0, [false, true]);
  out.after = hex(await client.readHoldingRegisters(0, 5));
  out.refused = [];
  for (const attempt of [() => client.writeSingleRegister(2, 1),
                         () => client.readHoldingRegisters(4, 2)]) {
    await attempt().then(() => out.refused.push(0), (e) => out.refused.push(e.response.body.code));
  }
  console.log(JSON.stringify(out));
  socket.end();
});
socket.connect({host: '127.9.80.1', port: 2502});
"""


def test_jsmodbus_reads_and_writes_the_served_registers(plant: Appliance) -> None:
    first = {"setpoint": 1.5, "on": True, "level": 9, "locked": False}
    plant.request("write", station="mill", values=first)
    wait_until(lambda: plant.values("mill")["temp"] == 21.5)
    found = node(JSMODBUS)
    temp = struct.pack(">f", 21.5).hex()
    assert found["holding"] == "3fc00000" + temp + "0009"
    assert int(found["count"], 16) > 0
    assert found["coils"] == [1, 0]
    assert found["discrete"][0] == 1
    assert found["after"] == "40b00000" + temp + "0011"
    assert found["refused"] == [2, 2]
    values = plant.values("mill")
    assert (values["setpoint"], values["level"]) == (5.5, 17)
    assert (values["on"], values["locked"]) == (False, True)


def connect(port: int, host: str) -> socket.socket:
    return socket.create_connection(("127.9.80.1", port), timeout=10, source_address=(host, 0))


def test_client_that_a_rule_denies_reads_but_does_not_write(plant: Appliance) -> None:
    plant.request("write", station="mill", values={"level": 3})
    before = plant.status()["processes"]["modbus"]["bridge"]["refused"]
    with connect(2502, "127.9.80.9") as client:
        client.sendall(bytes.fromhex("0001 0000 0006 03 06 0004 0005"))
        assert client.recv(100).hex() == "000100000003038604"
        client.sendall(bytes.fromhex("0002 0000 0006 03 03 0004 0001"))
        assert client.recv(100).hex()[-4:] in {"0003", "0011"}
    assert plant.values("mill")["level"] == 3
    wait_until(lambda: plant.status()["processes"]["modbus"]["bridge"]["refused"] > before)
    audit = Path(plant.status()["audit"]["file"]).read_text().splitlines()
    last = json.loads(audit[-1])
    assert (last["by"], last["asked"]) == ("modbus:127.9.80.9", {"values": {"level": 5}})
    assert "kiosk" in last["error"]


@pytest.mark.parametrize("port", [2102, 2502])
def test_bytes_that_are_no_protocol_end_one_connection_only(plant: Appliance, port: int) -> None:
    pid = plant.pid("s7" if port == 2102 else "modbus")
    with connect(port, "127.9.80.9") as good, connect(port, "127.9.80.9") as bad:
        bad.sendall(b"GET / HTTP/1.1\r\n\r\n" * 20)
        with suppress(ConnectionResetError):
            assert bad.recv(100) == b""
        request = "0001 0000 0006 03 03 0004 0001"
        if port == 2102:
            request = "03000016 11e00000 000200c0 010ac102 0100c202 0102"
        good.sendall(bytes.fromhex(request))
        assert good.recv(100)
    assert plant.pid("s7" if port == 2102 else "modbus") == pid


def test_changed_sources_are_followed_while_the_plant_runs(
    plant: Appliance, folder: Plants, press: Press
) -> None:
    wait_until(lambda: plant.values("mill")["temp"] == 21.5)
    struct.pack_into(">f", press.db1, 36, 33.5)
    changed = PLANT.replace("address: DB1.DBD4", "address: DB1.DBD36")
    changed = changed.replace("outside: {kind: s7, controller: press, address: DB9.DBW0}", "")
    file = folder.write(changed, "changed.yaml")
    plant.command("apply", str(file))
    wait_until(lambda: plant.values("mill")["temp"] == 33.5)
    wait_until(lambda: plant.values("mill")["press.ok"] is True)
    assert peer(plant, "s7")["failed"] == 0
    again = changed.replace("    press: {host", "    forge: {host")
    again = again.replace("controller: press", "controller: forge").replace("press.ok", "forge.ok")
    plant.command("apply", str(folder.write(again, "again.yaml")))
    wait_until(lambda: "restart the appliance" in str(peer(plant, "s7")["reason"]))
    # What the bridge read before it noticed is fresh until its time-out.
    wait_until(lambda: plant.values("mill")["forge.ok"] is False)
