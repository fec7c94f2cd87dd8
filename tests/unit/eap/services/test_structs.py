"""Structs and their members in the services: control methods, dictionary values, sources."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import msgspec
import pytest
from msgspec.structs import replace

from eap.control.protocol import ErrorCode
from eap.errors import ControlError
from eap.net.image_file import StationImage
from eap.od.profiles.eap1000_keys import EapLive
from eap.pd.spec import CsvSource, StationSpec, VariableSpec, Writer
from eap.services.control.methods import Methods
from eap.services.device.image_values import ImageValues
from eap.services.device.sources import play_sources
from tests.support.virtualtime import run_virtual
from tests.unit.eap.conftest import left, right

AXIS = (
    "ST_Axis<24/8:x@0 LREAL,state@8 E_State<INT:Off=0,On=1>,on@10 BOOL,name@11 STRING(5),"
    "at@16 LTIME>"
)


@pytest.fixture
def stations() -> tuple[StationSpec, StationSpec]:
    """The stations of the other tests, with a struct that is sent from one to the other."""
    sender, receiver = left(), right()
    (frame,) = sender.frames
    (pd,) = frame.pds
    names = (*pd.variables, "axis")
    frames = (replace(frame, pds=(replace(pd, variables=names),)),)
    axis = VariableSpec("axis", AXIS, default={"x": 1.5, "state": "On", "on": False, "name": "a",
                                               "at": "LTIME#7ns"})  # fmt: skip
    shadow = VariableSpec("shadow", AXIS, Writer.SERVICES)
    (subscription,) = receiver.subscriptions
    return (
        replace(sender, variables=(*sender.variables, axis, shadow), frames=frames),
        replace(
            receiver,
            variables=(*receiver.variables, VariableSpec("axis", AXIS, Writer.ENGINE)),
            subscriptions=(replace(subscription, variables=names),),
        ),
    )


@pytest.fixture
def methods(images: dict[str, StationImage]) -> Methods:
    async def status() -> dict[str, Any]:
        return {}

    return Methods({"plant": "demo", "release": "0"}, images, status=status, stop=lambda: None)


def call(methods: Methods, method: str, **params: Any) -> Any:
    return msgspec.to_builtins(run_virtual(methods.call(method, params)))


def test_control_reads_and_writes_members(methods: Methods) -> None:
    values = {"axis.state": "Off", "axis.at": "LTIME#1s", "axis.on": True}
    assert call(methods, "write", station="left", values=values) == {"written": 3}
    whole = {"x": 1.5, "state": "Off", "on": True, "name": "a", "at": "LTIME#1s"}
    answer = call(methods, "read", station="left", names=["axis", "axis.at", "ticks"])
    assert answer["values"] == {"axis": whole, "axis.at": "LTIME#1s", "ticks": 0}
    whole["name"] = "left"
    assert call(methods, "write", station="left", values={"axis": whole}) == {"written": 1}
    assert call(methods, "read", station="left", names=["axis.name"])["values"] == {
        "axis.name": "left"
    }


def test_received_member_has_the_quality_of_its_variable(methods: Methods) -> None:
    answer = call(methods, "read", station="right", names=["axis.x", "axis"])
    assert answer["quality"] == {"axis.x": None, "axis": None}


@pytest.mark.parametrize(
    ("station", "values", "code", "reason"),
    [
        ("left", {"axis.y": 1}, ErrorCode.UNKNOWN_NAME, "no 'axis.y': ST_Axis has no member 'y'"),
        ("left", {"axis.state": "Up"}, ErrorCode.VALUE, "'Up' is not a value of E_State"),
        ("left", {"axis": {"x": 1}}, ErrorCode.VALUE, "a value of ST_Axis lacks state, on, name"),
        ("right", {"axis.x": 1}, ErrorCode.REFUSED, "axis.x is written by the engine"),
    ],
)
def test_control_refuses_wrong_members(
    methods: Methods, station: str, values: dict[str, Any], code: ErrorCode, reason: str
) -> None:
    with pytest.raises(ControlError, match=reason) as caught:
        call(methods, "write", station=station, values=values)
    assert caught.value.code == code


def test_pd_list_has_the_name_of_a_type(methods: Methods) -> None:
    rows = {row["station"]: row for row in call(methods, "pd_list")}
    assert rows["left"]["variables"][-1]["type"] == "ST_Axis"
    listed = {row["name"]: row["type"] for row in call(methods, "variables", station="left")}
    assert listed["axis"] == AXIS


def test_dictionary_has_the_bytes_that_no_value_encodes_to(
    images: dict[str, StationImage], files: dict[str, Any]
) -> None:
    image = files["right"].image
    # A number without a name, and a text that is no UTF-8, as a peer may send them.
    octets = bytes(8) + b"\x63\0\7\xff\xff\xff\xff\xff" + bytes(8)
    slot = image.slots["axis"]
    image.memory[slot.bit_offset // 8 :][: len(octets)] = octets
    assert ImageValues(images["right"]).octets(EapLive.VALUE, "axis") == octets
    text = image.slots["name"]
    image.memory[text.bit_offset // 8 :][:8] = b"\xff" * 8
    assert ImageValues(images["right"]).octets(EapLive.VALUE, "name") == b"\xff" * 8


def test_source_of_services_fills_a_member(
    images: dict[str, StationImage], stations: tuple[StationSpec, ...], tmp_path: Path
) -> None:
    file = tmp_path / "states.csv"
    file.write_text('state,whole\nOn,"{x: 2.5, state: Off, on: on, name: b, at: 1s}"\n')

    def play(variable: str, column: str) -> Any:
        source = CsvSource(variable, file=str(file), column=column, period_ms=10)
        station = replace(stations[0], sources=(source,))

        async def briefly() -> Any:
            task = asyncio.create_task(play_sources(station, images["left"]))
            before = images["left"].image.read("shadow")
            while images["left"].image.read("shadow") == before:  # noqa: ASYNC110  a mapped file
                await asyncio.sleep(0.001)
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
            images["left"].release_writer(Writer.SERVICES)
            return images["left"].image.read("shadow")

        return run_virtual(asyncio.wait_for(briefly(), 20))

    assert play("shadow.state", "state")["state"].name == "On"
    assert play("shadow", "whole")["x"] == 2.5
