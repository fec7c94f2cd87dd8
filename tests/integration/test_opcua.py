"""The OPC UA server of a plant: the examples of docs/opcua.md, and clients of asyncua and npm."""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import socket
import struct
import subprocess
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from tests.support.appliance import Appliance, Plants, plants, run_eapctl, wait_until
from tests.support.npm import NODE_MODULES, needs_npm, node_environment
from tests.support.passwords import SECRET_HASH

pytestmark = [
    pytest.mark.net,
    pytest.mark.skipif(find_spec("asyncua") is None, reason="needs asyncua: pip install asyncua"),
]

PAGE = (Path(__file__).parents[2] / "docs/opcua.md").read_text()
CONTROL = (Path(__file__).parents[2] / "docs/control.md").read_text()
URL, CLOSED_URL = "opc.tcp://127.0.0.1:4840", "opc.tcp://127.0.0.1:4841"
PLANT = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)[0]
PLANT = PLANT.replace("scrypt$32768$8$1$…$…", SECRET_HASH)
# Changed for tests alone: what a client may not do, and values that are not received.
SOURCES = re.findall(r"    sources: .*\n", PLANT)[0]
PRESS = PLANT.replace(
    f"{SOURCES}opcua:\n",
    """\
      big: BLOCK(60000)
    sources: {speed: {kind: sine, offset: 50, amplitude: 5, period_ms: 5000}}
    subscribe:
      - name: far
        port: eap0
        from: {publisher: 9.9.9.9.2.1, id: 1}
        foreign: true
        variables: {far: UINT}
    access: [{name: locked, deny: [write], transports: [opcua], from: [127.0.0.7]}]
opcua:
""",
)
CLOSED = """\
plant: closed
stations:
  - name: closed
    net_id: 127.9.33.1.1.1
    ports: [{name: eap0, kind: eap, interface: "udp://127.9.33.1", net_id: 127.9.33.1.2.1}]
    variables: {speed: UINT}
opcua:
  listen: 127.0.0.1:4841
  security: [Basic256Sha256]
  users: [{name: anna, password: "HASH"}]
"""


@pytest.fixture(scope="module")
def folder() -> Iterator[Plants]:
    with plants() as found:
        found.state = found.folder / "state"
        (bus,) = re.findall(r"`oven.yaml` beside it:\n\n```yaml\n(.*?)```", CONTROL, re.DOTALL)
        found.write(bus, "oven.yaml")
        yield found


@pytest.fixture(scope="module")
def press(folder: Plants) -> Appliance:
    found = folder.start(folder.write(PRESS))
    closed = folder.start(folder.write(CLOSED.replace("HASH", SECRET_HASH), "closed.yaml"))
    for each in (found, closed):
        each.wait_ready()
        wait_until(lambda each=each: bridge_of(each).get("is_up"), 90)
    return found


def bridge_of(plant: Appliance) -> dict[str, Any]:
    found: dict[str, Any] = plant.status()["processes"]["opcua"].get("bridge", {})
    return found


@asynccontextmanager
async def connected(url: str = URL, user: str = "", password: str = "secret") -> AsyncIterator[Any]:
    from asyncua import Client

    # asyncua gives up a server that does not answer within this time, as one on a busy machine.
    client = Client(url, timeout=20, watchdog_intervall=20)
    if user:
        client.set_user(user)
        client.set_password(password)
    async with client:
        yield client


def in_session(work: Callable[[Any], Any], user: str = "", url: str = URL, **more: str) -> Any:
    async def run() -> Any:
        async with asyncio.timeout(60), connected(url, user, **more) as client:
            return await work(client)

    return asyncio.run(run())


def node(client: Any, name: str) -> Any:
    return client.get_node(f"ns=2;s={name}")


def refusal(work: Callable[[Any], Any], user: str = "", url: str = URL, **more: str) -> str:
    """Return the name of the status with which the server refuses *work*."""
    from asyncua import ua

    with pytest.raises(ua.UaError) as caught:
        in_session(work, user, url, **more)
    return type(caught.value).__name__


def test_example_of_the_page_runs(press):
    (program,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    exec(compile(program, "opcua.md", "exec"), {})


def test_nodes_are_those_of_the_page(press):
    async def browse(client: Any) -> dict[str, list[str]]:
        found = {}

        async def walk(one: Any) -> None:
            children = await one.get_children()
            found[one.nodeid.Identifier] = [each.nodeid.Identifier for each in children]
            for each in children:
                await walk(each)

        await walk(node(client, "press"))
        uris = await client.get_namespace_array()
        assert uris[2] == "urn:eap-appliance:plant:press"
        return found

    found = in_session(browse)
    for name in ("press/state", "press/net_id", "press/speed", "press#RequestState"):
        assert name in found["press"]
    assert "press/axis.position" in found["press/axis"]
    assert "press/bus0#Rescan" in found["press/bus0"]
    assert found["press/bus0.door"][-1] == "press/bus0.door.state"
    assert found["press/speed"] == ["press/speed#EngineeringUnits", "press/speed#EURange"]


def test_variables_have_quality_time_range_and_state(press):
    from asyncua import ua

    async def read(client: Any) -> None:
        speed = await node(client, "press/speed").read_data_value()
        far = await node(client, "press/far").read_data_value(raise_on_bad_status=False)
        assert far.StatusCode.name == "BadWaitingForInitialData"
        limits = await node(client, "press/speed#EURange").read_value()
        assert (limits.Low, limits.High) == (0, 100)
        later = await node(client, "press/speed").read_data_value()
        assert later.SourceTimestamp >= speed.SourceTimestamp
        assert 0 <= (later.ServerTimestamp - later.SourceTimestamp).total_seconds() < 5
        assert await node(client, "press/state").read_value() == 8
        assert await client.get_node("i=2267").read_value() == 255  # ServiceLevel
        assert (await client.get_node("i=2256").read_value()).State == ua.ServerState.Running
        assert await client.get_node("i=3709").read_value() == 0  # RedundancySupport

    in_session(read)


def write(name: str, value: Any, kind: str = "UInt16") -> Callable[[Any], Any]:
    from asyncua import ua

    return lambda client: node(client, f"press/{name}").write_value(value, ua.VariantType[kind])


def audit(press: Appliance) -> list[dict[str, Any]]:
    file = Path(press.status()["audit"]["file"])
    return [json.loads(line) for line in file.read_text().splitlines()]


def test_writes_follow_role_rule_and_type(press):
    assert refusal(write("setpoint", 1)) == "BadUserAccessDenied"
    assert refusal(write("limit", 1), "anna") == "BadUserAccessDenied"
    assert refusal(write("speed", 1.0, "Double"), "otto") == "BadNotWritable"
    assert refusal(write("limit", "x", "String"), "otto") == "BadTypeMismatch"
    assert refusal(write("axis.moved", -5.0, "Double"), "otto") == "BadOutOfRange"
    assert refusal(write("gone", 1), "otto") == "BadNodeIdUnknown"
    in_session(write("limit", 11), "otto")
    in_session(write("setpoint", 12), "anna")
    assert [press.values("press")[name] for name in ("limit", "setpoint")] == [11, 12]
    lines = audit(press)
    assert lines[-2]["by"] == "opcua:otto@127.0.0.1"
    assert lines[-1]["asked"] == {"values": {"setpoint": 12}}


def test_structs_are_written_whole_and_by_member(press):
    async def change(client: Any) -> Any:
        await client.load_data_type_definitions()
        axis = await node(client, "press/axis").read_value()
        axis.position, axis.path[1].x = 3.5, 7.0
        await node(client, "press/axis").write_value(axis)
        await write("axis.state", 1, "Int32")(client)
        await write("axis.moved", 1500.0, "Double")(client)
        await write("curve", [1.0, 2.0, 3.0, 4.0], "Float")(client)
        return await node(client, "press/axis").read_value()

    read = in_session(change, "otto")
    assert (read.position, read.state.name, read.moved) == (3.5, "Moving", 1500.0)
    values = press.values("press")
    assert values["axis"] == {
        "position": 3.5,
        "state": "Moving",
        "moved": "T#1s500ms",
        "path": [{"x": 0.0, "y": 0.0}, {"x": 7.0, "y": 0.0}],
    }
    assert values["curve"] == [1.0, 2.0, 3.0, 4.0]


def test_methods_change_state_and_scan_the_bus(press):
    from asyncua import ua

    async def call(client: Any) -> None:
        for number in (4, 8):
            state = ua.Variant(number, ua.VariantType.Int32)
            await node(client, "press").call_method("2:RequestState", state)
            assert await node(client, "press/state").read_value() == number
        await rescan(client)

    def rescan(client: Any) -> Any:
        return node(client, "press/bus0").call_method("2:Rescan")

    in_session(call, "otto")
    by_method = {line["operation"]: line for line in audit(press)}
    assert by_method["request_state"]["asked"]["state"] == "OP"
    assert by_method["ams_ask"]["by"] == "opcua:otto@127.0.0.1"
    assert refusal(rescan, "anna") == "BadUserAccessDenied"


def test_wrong_password_and_channel_without_security_are_refused(press):
    async def nothing(client: Any) -> None:
        del client

    assert refusal(nothing, "nobody") == "BadUserAccessDenied"
    assert refusal(nothing, "anna", password="wrong") == "BadUserAccessDenied"
    assert refusal(nothing, "anna", CLOSED_URL) == "BadSecurityPolicyRejected"
    wait_until(lambda: press.status()["logins"].get("opcua", {}).get("wrong") == 2)


PEER = r"""
const o = require("node-opcua");
const dynamic = require("node-opcua-client-dynamic-extension-object");
const [url, policy, user, password] = process.argv.slice(1);
const say = (what) => console.log(JSON.stringify(what));
const value = (name) => ({ nodeId: "ns=2;s=press/" + name, attributeId: o.AttributeIds.Value });
const told = () => new Promise((done) => process.stdin.once("data", done));
async function connect() {
  const client = o.OPCUAClient.create({
    securityPolicy: o.SecurityPolicy[policy], securityMode: o.MessageSecurityMode.SignAndEncrypt,
    connectionStrategy: { maxRetry: 0 }, endpointMustExist: false, keepSessionAlive: false,
  });
  await client.connect(url);
  return client;
}
(async () => {
  try { await connect(); say("connected"); } catch (error) { say("refused"); }
  await told();
  const client = await connect();
  const login = { type: o.UserTokenType.UserName, userName: user };
  try { await client.createSession({ ...login, password: "wrong" }); }
  catch (error) { say(error.message.match(/Bad\w+/)[0]); }
  const session = await client.createSession({ ...login, password });
  const browsed = await session.browse("ns=2;s=press");
  say(browsed.references.map((each) => each.browseName.name));
  const speed = await session.read(value("speed"));
  say([o.DataType[speed.value.dataType], speed.statusCode.name, speed.sourceTimestamp.getTime()]);
  const types = await dynamic.getExtraDataTypeManager(session);
  const axis = await session.read(value("axis"));
  await dynamic.resolveDynamicExtensionObject(session, axis.value, types);
  say(axis.value.value);
  const write = async (name, dataType, what) => {
    const value_ = { value: { dataType, value: what } };
    say((await session.write({ ...value(name), value: value_ })).name);
  };
  axis.value.value.position = 9.25;
  await write("axis", o.DataType.ExtensionObject, axis.value.value);
  say((await session.read(value("axis.position"))).value.value);
  await write("setpoint", o.DataType.UInt16, 66);
  await write("speed", o.DataType.Double, 66);
  await write("setpoint", o.DataType.String, "x");
  const subscription = await session.createSubscription2({
    requestedPublishingInterval: 50, requestedLifetimeCount: 100,
    requestedMaxKeepAliveCount: 10, publishingEnabled: true,
  });
  const changes = [];
  const item = await subscription.monitor(
    value("speed"), { samplingInterval: 50, queueSize: 10, discardOldest: true },
    o.TimestampsToReturn.Both);
  await new Promise((done) => item.on("changed", (one) => {
    if (changes.push(one.value.value) == 3) done();
  }));
  say(new Set(changes).size);
  const state = { objectId: "ns=2;s=press", methodId: "ns=2;s=press#RequestState" };
  const inputArguments = [{ dataType: o.DataType.Int32, value: 8 }];
  const called = await session.call({ ...state, inputArguments });
  say(called.statusCode.name);
  await subscription.terminate();
  await session.close();
  await client.disconnect();
  process.exit(0);
})().catch((error) => { console.error(error); process.exit(1); });
"""


@needs_npm("node-opcua")
def test_node_opcua_uses_a_signed_and_encrypted_channel_with_a_user(press, tmp_path):
    folder = Path(press.status()["audit"]["file"]).parent / "opcua"
    peer = subprocess.Popen(
        ["node", "-e", PEER, "--", URL, "Aes256_Sha256_RsaPss", "otto", "secret"],
        env=node_environment() | {"HOME": str(tmp_path), "XDG_CONFIG_HOME": str(tmp_path)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    with peer:
        try:
            assert peer.stdin is not None
            said = spoken(peer)
            assert next(said) == "refused"
            (rejected,) = (folder / "rejected").glob("*.der")
            rejected.rename(folder / "trusted" / rejected.name)
            peer.stdin.write("go\n")
            peer.stdin.flush()
            assert next(said) == "BadUserAccessDenied"
            assert {"state", "speed", "axis", "bus0"} <= set(next(said))
            kind, status, at_ms = next(said)
            assert (kind, status) == ("Double", "Good")
            assert at_ms > 1.79e12
            axis = next(said)
            assert list(axis) == ["position", "state", "moved", "path"]
            assert [list(each) for each in axis["path"]] == [["x", "y"]] * 2
            assert [next(said), next(said)] == ["Good", 9.25]
            assert [next(said) for _ in range(3)] == ["Good", "BadNotWritable", "BadTypeMismatch"]
            assert next(said) == 3
            assert next(said) == "Good"
            assert peer.wait(20) == 0
        finally:
            peer.kill()
    assert press.values("press")["setpoint"] == 66
    assert press.values("press")["axis"]["position"] == 9.25


@needs_npm("node-red", "node-red-contrib-opcua")
def test_node_red_runs_the_flow_of_the_page(press, tmp_path):
    (flow,) = re.findall(r"```json\n(.*?)```", PAGE, re.DOTALL)
    (tmp_path / "flow.json").write_text(flow)
    (tmp_path / "flow_cred.json").write_text(
        json.dumps({"press-2": {"user": "anna", "password": "secret"}})
    )
    nodes = "node-red-contrib-opcua"  # alone: to load all that are installed takes long
    (tmp_path / "node_modules").mkdir()
    (tmp_path / "node_modules" / nodes).symlink_to(NODE_MODULES / nodes)
    settings = {
        "uiPort": 0,
        "uiHost": "127.0.0.1",
        "flowFile": "flow.json",
        "httpAdminRoot": False,
        "httpNodeRoot": False,
        "telemetry": {"enabled": False},
        "credentialSecret": False,
        "externalModules": {"palette": {"denyList": ["node-red-contrib-ads-client"]}},
    }
    (tmp_path / "settings.js").write_text(f"module.exports = {json.dumps(settings)};")
    values, log = tmp_path / "values.txt", tmp_path / "log"
    with log.open("w") as out:
        red = subprocess.Popen(
            ["node", str(NODE_MODULES / "node-red" / "red.js"), "-u", str(tmp_path)],
            cwd=tmp_path,
            env=node_environment() | {"HOME": str(tmp_path)},
            stdout=out,
            stderr=out,
        )
    with red:
        try:
            wait_until(lambda: len(speeds(values)) > 3, 100)
            wait_until(lambda: press.values("press")["setpoint"] == 33)
        except AssertionError:
            pytest.fail(log.read_text())
        finally:
            red.kill()


def speeds(file: Path) -> list[float]:
    """Return the values of ``speed`` in a file of Node-RED, which has answers to writes, too."""
    words = file.read_text().split() if file.exists() else []
    numbers = [float(each) for each in words if re.fullmatch(r"[0-9.]+", each)]
    return [each for each in numbers if 45 <= each <= 55]


def spoken(peer: subprocess.Popen[str]) -> Iterator[Any]:
    """Yield what a peer says; other lines are of its library."""
    assert peer.stdout is not None
    for line in peer.stdout:
        with suppress(json.JSONDecodeError):
            yield json.loads(line)


async def until_good(client: Any, name: str) -> None:
    """Return when a node has a good value: values pause while the server subscribes anew."""
    found = node(client, name)
    is_good = False
    while not is_good:
        value = await found.read_data_value(raise_on_bad_status=False)
        is_good = value.StatusCode.is_good()


def test_nodes_follow_a_changed_configuration_while_clients_are_connected(press, folder):
    """Nodes come, go and change; monitored items of those that stay go on."""
    changed = PRESS.replace("limit: UINT", "limit: LREAL\n      added: UINT").replace(
        '      curve: "REAL[4]"\n', ""
    )

    async def follow(client: Any) -> None:
        told = Told()
        subscription = await client.create_subscription(50, told)
        for name in ("limit", "curve", "speed"):
            await subscription.subscribe_data_change(node(client, f"press/{name}"))
        await subscription.subscribe_events(evtypes=2132)  # BaseModelChangeEventType
        await told.until(lambda: len(told.values) >= 3)
        done = await asyncio.to_thread(
            run_eapctl, press.runtime, "apply", str(folder.write(changed, "changed.yaml"))
        )
        assert done.returncode == 0, done.stdout + done.stderr
        await told.until(lambda: told.last("press/curve") == "BadNodeIdUnknown" and told.events)
        assert (await node(client, "press/added").read_value()) == 0
        await told.until(lambda: told.last("press/limit") == 0.0)
        limit = await node(client, "press/limit").read_data_type()
        assert limit.Identifier == 11
        count = len(told.values)
        await told.until(lambda: len(told.values) > count)
        with pytest.raises(Exception, match="BadNodeIdUnknown"):
            await node(client, "press/curve").read_value()
        done = await asyncio.to_thread(
            run_eapctl, press.runtime, "rollback", str(folder.folder / "changed.yaml")
        )
        assert done.returncode == 0, done.stdout + done.stderr
        for name in ("curve", "speed"):
            await until_good(client, f"press/{name}")

    in_session(follow)


class Told:
    """Handler of a subscription: names with their latest values, or bad status, and events."""

    def __init__(self) -> None:
        self.values: list[tuple[str, Any]] = []
        self.events: list[Any] = []
        self._news = asyncio.Event()

    def datachange_notification(self, one: Any, value: Any, data: Any) -> None:
        status = data.monitored_item.Value.StatusCode
        what = value if status is None or not status.is_bad() else status.name
        self.values.append((one.nodeid.Identifier, what))
        self._news.set()

    def event_notification(self, event: Any) -> None:
        self.events.append(event)
        self._news.set()

    def last(self, name: str) -> Any:
        return next((value for each, value in reversed(self.values) if each == name), None)

    async def until(self, condition: Callable[[], object]) -> None:
        while not condition():
            self._news.clear()
            await self._news.wait()


def test_server_goes_on_with_many_clients_and_without_some(press):
    """100 sessions, of which half break off."""
    # A session that a client of an earlier test left with a subscription waits for it to return.

    async def crowd() -> None:
        from asyncua import Client

        clients = [Client(URL, timeout=60, watchdog_intervall=60) for _ in range(100)]
        try:
            async with asyncio.TaskGroup() as group:
                for each in clients:
                    group.create_task(each.connect())
            async with asyncio.TaskGroup() as group:
                reads = [group.create_task(node(c, "press/speed").read_value()) for c in clients]
            assert all(45 <= each.result() <= 55 for each in reads)
            await asyncio.to_thread(wait_until, lambda: bridge_of(press)["clients"] >= 100)
            for each in clients[:50]:
                each.uaclient.protocol.transport.abort()
            read = await node(clients[-1], "press/speed").read_value()
            assert 45 <= read <= 55
        finally:
            async with asyncio.TaskGroup() as group:
                for each in clients[50:]:
                    group.create_task(each.disconnect())
        await asyncio.to_thread(wait_until, lambda: bridge_of(press)["clients"] < 10)

    asyncio.run(crowd())


def test_client_that_reads_no_answers_is_disconnected(press):
    async def flood() -> None:
        async with asyncio.timeout(90), connected() as client:
            transport = client.uaclient.protocol.transport
            transport.pause_reading()
            big = node(client, "press/big").nodeid
            async with asyncio.TaskGroup() as group:
                for _ in range(40):
                    group.create_task(unanswered(client.uaclient.read_attributes([big] * 10, 13)))
                await asyncio.to_thread(wait_until, lambda: bridge_of(press)["dropped"] == 1)
                transport.resume_reading()

    async def unanswered(answer: Any) -> None:
        with suppress(Exception):
            await answer

    with suppress(Exception):  # of the closed session
        asyncio.run(flood())
    assert bridge_of(press)["dropped"] == 1
    in_session(lambda client: node(client, "press/speed").read_value())


def test_plant_that_restarts_leaves_sessions_and_values_go_on(press):
    async def survive(client: Any) -> None:
        told = Told()
        subscription = await client.create_subscription(50, told)
        await subscription.subscribe_data_change(node(client, "press/speed"))
        await told.until(lambda: told.values)
        os.kill(press.pid("services"), signal.SIGKILL)
        count = len(told.values)
        await told.until(lambda: len(told.values) > count + 5)
        await told.until(lambda: isinstance(told.last("press/speed"), float))
        await until_good(client, "press/speed")

    in_session(survive)


def test_garbage_is_refused_and_the_server_goes_on(press):
    for garbage in (b"GET / HTTP/1.1\r\n\r\n", b"HELF" + struct.pack("<I", 0xFFFFFFFF) + bytes(64)):
        with socket.create_connection(("127.0.0.1", 4840), timeout=20) as peer:
            peer.sendall(garbage)
            peer.shutdown(socket.SHUT_WR)
            while peer.recv(4096):
                pass
    in_session(lambda client: node(client, "press/speed").read_value())
