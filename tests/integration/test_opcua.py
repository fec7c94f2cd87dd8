"""The OPC UA server of a plant: the examples of docs/opcua.md, and clients of asyncua and npm."""

from __future__ import annotations

import asyncio
import json
import re
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from eap.config.passwords import PasswordHash
from tests.support.appliance import Appliance, Plants, plants, wait_until

pytestmark = [
    pytest.mark.net,
    pytest.mark.skipif(find_spec("asyncua") is None, reason="needs asyncua: pip install asyncua"),
]

PAGE = (Path(__file__).parents[2] / "docs/opcua.md").read_text()
CONTROL = (Path(__file__).parents[2] / "docs/control.md").read_text()
URL, CLOSED_URL = "opc.tcp://127.0.0.1:4840", "opc.tcp://127.0.0.1:4841"
HASH = str(PasswordHash.of("secret", bytes(16)))
PLANT = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)[0].replace("scrypt$32768$8$1$…$…", HASH)
# Changed for tests alone: what a client may not do, and values that are not received.
PRESS = PLANT.replace(
    "opcua:\n",
    """\
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
    closed = folder.start(folder.write(CLOSED.replace("HASH", HASH), "closed.yaml"))
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

    client = Client(url, timeout=20)
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
