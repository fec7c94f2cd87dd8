"""The control methods of devices."""

from __future__ import annotations

from inspect import isawaitable

import msgspec
import pytest
from msgspec.structs import replace

from eap.control import device as control_device
from eap.control.protocol import ErrorCode
from eap.device.eap_dictionary import DeviceIdentity
from eap.device.live_dictionaries import RouterDictionary
from eap.errors import ControlError, EngineRefusedError
from eap.ids import InterfaceUri, NetId, decode_value, encode_value
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.profiles.eap1000 import FrameSub, Tx
from eap.pd.spec import PortKind, PortSpec, StationSpec
from eap.runtime.store import StationStore, digest_of
from eap.services.control.device_methods import DeviceMethods
from tests.support.routervalues import Values
from tests.support.stationengine import make_device
from tests.support.virtualtime import run_virtual

BUS_ONLY = StationSpec(
    "io",
    NetId.parse("3.3.3.3.3.3"),
    10_000,
    (
        PortSpec(
            "bus0", PortKind.BUS, InterfaceUri.parse("sim://x.yaml"), NetId.parse("3.3.3.3.4.1")
        ),
    ),
)


@pytest.fixture
def device(stations):
    return make_device(stations[0])


@pytest.fixture
def methods(device, stations):
    devices = [device[0], make_device(stations[1])[0], make_device(BUS_ONLY)[0]]
    routers = {
        each.name: RouterDictionary(each.spec, Values(), DeviceIdentity()) for each in devices
    }
    return DeviceMethods({each.name: each for each in devices}, routers, "/x/plant.yaml").table()


@pytest.fixture
def call(methods):
    def call(method, **params):
        async def run():
            result = methods[method](params)
            return await result if isawaitable(result) else result

        return msgspec.json.decode(msgspec.json.encode(run_virtual(run()), enc_hook=encode_value))

    return call


def test_od_list_has_all_objects(call):
    rows = call("od_list", target="left")
    assert rows["next"] is None
    assert rows["objects"][0] == {
        "index": 0x1000,
        "name": "Device type",
        "label": "",
        "code": "VAR",
        "max_subindex": 0,
    }
    assert call("od_list", target="left/eap0") == rows
    assert {row["label"] for row in rows["objects"] if row["index"] == 0xD000} == {"state"}
    mappable = [row["index"] for row in call("od_list", target="left", list="tx")["objects"]]
    assert mappable
    assert all(0x6000 <= index < 0x7000 for index in mappable)


@pytest.mark.parametrize("method", ["od_list", "od_dump"])
def test_long_lists_come_in_parts(call, monkeypatch, method):
    whole = call(method, target="left")["objects"]
    monkeypatch.setattr(control_device, "PAGE", 1000)
    rows, first = [], 0
    while first is not None:
        part = call(method, target="left", first=first)
        assert part["objects"]
        rows += part["objects"]
        first = part["next"]
    assert rows == whole


def test_od_describe_has_the_entries(call):
    row = call("od_describe", target="left", index=0xD000)
    assert (row["name"], row["code"]) == ("TxPD 0", "RECORD")
    entry = next(each for each in row["entries"] if each["subindex"] == Tx.CYCLE_TIME)
    assert entry == {
        "subindex": 7,
        "name": "Cycle time",
        "type": "UDINT",
        "bits": 32,
        "access": "rw",
        "rights": 0x010F,
        "unit": "us",
        "default": "00000000",
        "minimum": None,
        "maximum": None,
    }
    with pytest.raises(SdoAbortError) as caught:
        call("od_describe", target="left", index=0x4000)
    assert caught.value.code == AbortCode.NO_OBJECT


def test_describe_object_that_a_download_would_create(call):
    def entries(index, subindex=None):
        row = call("od_describe", target="left", index=index, subindex=subindex)
        return {each["subindex"]: each["type"] for each in row["entries"]}

    assert entries(0x1A77, 3) == {0: "USINT", 1: "UDINT", 2: "UDINT", 3: "UDINT"}
    assert entries(0xD077)[Tx.PD_ID] == "UINT"
    assert max(entries(0x8000)) == FrameSub.TXPD
    assert entries(0x8000, 20)[20] == "UINT"
    assert max(entries(0x8000, 5)) == FrameSub.TXPD
    assert 0x9999 not in [row["index"] for row in call("od_list", target="left")["objects"]]
    assert 0x1A77 not in [row["index"] for row in call("od_list", target="left")["objects"]]
    with pytest.raises(SdoAbortError):
        entries(0x9999, 1)


def test_read_and_write(call):
    assert call("od_read", target="left", index=0xD000, subindex=3) == {"data": "0700"}
    whole = call("od_read", target="left", index=0xF000, subindex=0, complete=True)
    assert whole["data"].startswith("0200")
    with pytest.raises(SdoAbortError) as caught:
        call("od_write", target="left", index=0xD000, subindex=3, data="0800")
    assert caught.value.code == AbortCode.DEVICE_STATE
    assert call("od_write", target="left", index=0xF200, subindex=1, data="0200") == {}
    assert call("od_write", target="left", index=0xD000, subindex=3, data="0800") == {}
    assert call("od_read", target="left", index=0xD000, subindex=3) == {"data": "0800"}
    whole = call("od_read", target="left", index=0x1A00, subindex=0, complete=True)["data"]
    assert (
        call("od_write", target="left", index=0x1A00, subindex=0, data=whole, complete=True) == {}
    )


def test_dump_has_values(call):
    rows = {row["index"]: row for row in call("od_dump", target="left")["objects"]}
    values = {each["subindex"]: each["data"] for each in rows[0xD000]["entries"]}
    assert values[Tx.PD_ID] == "0700"


def test_state_is_read_and_requested(call, device):
    assert call("state", target="left") == {"state": "OP", "error": None}
    assert call("request_state", target="left/eap0", state="preop") == {
        "state": "PREOP",
        "error": None,
    }
    call("od_write", target="left", index=0xD000, subindex=1, data="0000")
    refused = call("request_state", target="left", state="OP")
    assert refused["state"] == "PREOP"
    assert refused["error"] == {
        "code": 0x8002,
        "text": "0xD000:01: PD has no PDO",
        "port": "eap0",
        "index": 0xD000,
        "subindex": 1,
    } | {"text": refused["error"]["text"]}
    assert "0xD000:01: PD has no PDO" in refused["error"]["text"]
    assert call("state", target="left") == refused
    assert call("request_state", target="left", state="BOOT")["error"]["code"] == 0x12


def test_export_plan_apply_and_rollback(call, stations, device):
    exported, *rest = call("export", station="left").values()
    assert rest == [None, "", False]
    assert msgspec.convert(exported, StationSpec, dec_hook=decode_value) == stations[0]
    exported["frames"][0]["pds"][0]["version"] = 5
    changed = {
        "port": "eap0",
        "index": 0xD000,
        "subindex": 4,
        "name": "TxPD 0 (state): Version",
        "change": "changed",
        "old": "0",
        "new": "5",
        "unit": "",
    }
    plan = {"changes": [changed], "station": [], "refused": []}
    assert call("plan", station="left", spec=exported) == plan
    assert call("apply", station="left", spec=exported) == {
        "ok": True,
        "results": [changed | {"ok": True, "reason": ""}],
        "station": [],
        "refused": [],
    }
    before = call("export", station="left")["previous"]
    assert msgspec.convert(before, StationSpec, dec_hook=decode_value) == stations[0]
    assert call("export", station="left")["spec"] == exported
    assert call("plan", station="left", spec=exported)["changes"] == []
    back = call("rollback", station="left")
    assert [(row["old"], row["new"], row["ok"]) for row in back["results"]] == [("5", "0", True)]
    assert call("rollback", station="left", spec=exported)["ok"] is True
    assert call("rollback", station="left", spec=exported)["results"] == []
    after = call("export", station="left")
    assert (after["spec"], after["undone"]) == (exported, False)
    exported["frames"][0]["pds"][0]["version"] = 6
    assert call("rollback", station="left", spec=exported)["refused"] == [
        "meanwhile it would go back to something else"
    ]


@pytest.mark.parametrize(
    ("file", "is_own"), [("", False), ("/y/plant.yaml", False), ("/x/plant.yaml", True)]
)
def test_apply_of_the_own_plant_file_is_noted(call, stations, file, is_own):
    spec = replace(stations[0], cycle_us=20_000)
    assert call(
        "apply", station="left", spec=msgspec.to_builtins(spec, enc_hook=encode_value), file=file
    )["ok"]
    stored = StationStore("demo", "left").configuration.read()
    assert stored is not None
    assert stored.applied == (digest_of(spec) if is_own else "")


def test_apply_of_another_interface_is_refused(call, stations, device):
    spec = call("export", station="left")["spec"]
    spec["ports"][0]["interface"] = "udp://0.0.0.0"
    refused = call("apply", station="left", spec=spec)
    assert (refused["ok"], refused["results"], len(refused["refused"])) == (False, [], 1)
    device[1].failure = EngineRefusedError("no memory")
    spec = msgspec.to_builtins(replace(stations[0], cycle_us=20_000), enc_hook=encode_value)
    refused = call("apply", station="left", spec=spec)
    assert refused["ok"] is False
    assert "no memory" in refused["refused"][0]
    assert [(row["ok"], row["reason"]) for row in refused["results"]] == [
        (False, refused["refused"][0])
    ]


def test_router_has_a_dictionary_beside_those_of_ports(call):
    for station in ("left", "io"):
        rows = call("od_list", target=f"{station}/router")["objects"]
        assert [row["index"] for row in rows][:2] == [0x1000, 0x1008]
        assert call("od_read", target=f"{station}/router", index=0x1000, subindex=0) == {
            "data": "89132823"
        }
    whole = call("od_read", target="io/router", index=0xF010, subindex=0, complete=True)
    assert whole == {"data": "01004c040000"}
    described = call("od_describe", target="io/router", index=0x8000, subindex=7)
    assert (described["label"], described["entries"][7]["name"]) == ("bus0", "Name")
    assert call("od_dump", target="left/router")["objects"][0]["entries"][0]["data"] == "89132823"
    assert call("state", target="io/router")["state"] == "OP"
    with pytest.raises(SdoAbortError) as refused:
        call("od_write", target="left/router", index=0xF000, subindex=1, data="0100")
    assert refused.value.code == AbortCode.READ_ONLY
    with pytest.raises(SdoAbortError) as refused:
        call("od_describe", target="left/router", index=0x9000)
    assert refused.value.code == AbortCode.NO_OBJECT


@pytest.mark.parametrize(
    ("method", "params", "message"),
    [
        ("od_list", {"target": "lft"}, "unknown station 'lft', did you mean left"),
        ("od_list", {"target": "left/eap1"}, "its EAP ports are eap0, did you mean eap0"),
        ("od_list", {"target": "io"}, "no EAP port; the dictionary of its router is at io/router"),
        ("od_list", {"target": "left/routr"}, "did you mean router"),
        ("export", {"station": "x"}, "unknown station 'x'"),
    ],
)
def test_unknown_names_are_refused(call, method, params, message):
    with pytest.raises(ControlError, match=message) as caught:
        call(method, **params)
    assert caught.value.code == ErrorCode.UNKNOWN_NAME


@pytest.mark.parametrize(
    ("method", "params"),
    [
        ("od_read", {"target": "left", "index": 0x10000, "subindex": 0}),
        ("od_read", {"target": "left", "index": 1, "subindex": 256}),
        ("od_write", {"target": "left", "index": 1, "subindex": 0, "data": "xy"}),
        ("od_list", {"target": "left", "list": "some"}),
        ("apply", {"station": "left", "spec": {}}),
        ("state", {}),
    ],
)
def test_wrong_parameters_are_refused(call, method, params):
    with pytest.raises(ControlError, match="params: ") as caught:
        call(method, **params)
    assert caught.value.code == ErrorCode.BAD_REQUEST
