"""The methods of the control protocol on real images, without a socket."""

from __future__ import annotations

import asyncio
import subprocess
import sys

import msgspec
import pytest
from msgspec.structs import replace

from eap.control.protocol import ErrorCode
from eap.errors import ControlError
from eap.net.image_file import create_image
from eap.pd.layout import plan_layout
from eap.pd.spec import VariableSpec, Writer
from eap.pd.words import StationWord
from eap.services.control.methods import Methods


async def status():
    return {"version": 1}


def call(methods: Methods, method: str, params: dict):
    return msgspec.to_builtins(asyncio.run(methods.call(method, params)))


@pytest.fixture
def stopped():
    return []


@pytest.fixture
def methods(images, stopped):
    return Methods(
        {"plant": "demo", "release": "0"},
        images,
        status=status,
        stop=lambda: stopped.append(True),
    )


def refusal(methods: Methods, method: str, params: dict) -> ControlError:
    with pytest.raises(ControlError) as caught:
        call(methods, method, params)
    return caught.value


def test_hello_status_and_stop(methods, stopped):
    assert call(methods, "hello", {}) == {
        "version": 1,
        "plant": "demo",
        "release": "0",
        "pid": 0,
        "stations": ["left", "right"],
        "host": "",
        "plant_file": "",
        "audit_required": False,
        "by_ads": [],
    }
    assert call(methods, "status", {}) == {"version": 1}
    assert call(methods, "stop", {}) == {"stopping": True}
    assert stopped == [True]


def test_pd_list_of_one_and_of_all(methods):
    rows = call(methods, "pd_list", {})
    assert [(row["station"], row["direction"], row["name"]) for row in rows] == [
        ("left", "tx", "state"),
        ("right", "rx", "left-state"),
    ]
    assert call(methods, "pd_list", {"station": "left"}) == rows[:1]


def test_variables_with_type_and_writer(methods):
    rows = {row["name"]: row for row in call(methods, "variables", {"station": "left"})}
    assert rows["setpoint"] == {
        "name": "setpoint",
        "type": "REAL[2]",
        "writer": "application",
        "unit": "bar",
        "comment": "pressure",
    }
    assert rows["ticks"]["writer"] == "engine"


def test_written_values_are_read(methods):
    values = {"setpoint": [1, 2.5], "running": True, "name": "xyz"}
    assert call(methods, "write", {"station": "left", "values": values}) == {"written": 3}
    answer = call(methods, "read", {"station": "left", "names": ["setpoint", "running", "name"]})
    assert answer["values"] == {"setpoint": [1.0, 2.5], "running": True, "name": "xyz"}
    assert answer["station"] == "left"
    everything = call(methods, "read", {"station": "left"})["values"]
    assert everything["load"] == 0
    assert everything["name"] == "xyz"


def test_received_values_have_a_quality(methods):
    answer = call(methods, "read", {"station": "right", "names": ["ticks"]})
    assert answer["quality"] == {"ticks": None}
    assert call(methods, "read", {"station": "left", "names": ["ticks"]})["quality"] == {}


@pytest.mark.parametrize(
    ("method", "params", "code", "text"),
    [
        ("red", {}, ErrorCode.UNKNOWN_METHOD, "did you mean read"),
        ("bus_opn", {}, ErrorCode.UNKNOWN_METHOD, "did you mean bus_open"),
        ("read", {"station": "lefd"}, ErrorCode.UNKNOWN_NAME, "did you mean left"),
        (
            "read",
            {"station": "left", "names": ["setpint"]},
            ErrorCode.UNKNOWN_NAME,
            "did you mean setpoint",
        ),
        ("read", {}, ErrorCode.BAD_REQUEST, "station"),
        ("read", {"station": "left", "nmes": []}, ErrorCode.BAD_REQUEST, "nmes"),
        ("status", {"verbose": True}, ErrorCode.BAD_REQUEST, "verbose"),
        ("write", {"station": "left", "values": {"x": None}}, ErrorCode.BAD_REQUEST, "null"),
        ("write", {"station": "left", "values": {"running": 2}}, ErrorCode.VALUE, "running"),
        (
            "write",
            {"station": "left", "values": {"setpoint": [1]}},
            ErrorCode.VALUE,
            "setpoint",
        ),
        ("write", {"station": "left", "values": {"ticks": 1}}, ErrorCode.REFUSED, "engine"),
        ("write", {"station": "right", "values": {"tick": 1}}, ErrorCode.UNKNOWN_NAME, "ticks"),
    ],
)
def test_refusals_have_a_code_and_a_hint(methods, method, params, code, text):
    error = refusal(methods, method, params)
    assert error.code == code
    assert text in str(error)


def test_nothing_is_written_when_one_value_is_wrong(methods):
    refusal(methods, "write", {"station": "left", "values": {"running": True, "setpoint": "x"}})
    assert call(methods, "read", {"station": "left", "names": ["running"]})["values"] == {
        "running": False
    }


def test_a_user_program_that_writes_is_named(methods, files):
    code = (
        "import sys\n"
        "from pathlib import Path\n"
        "from eap.net.image_file import open_image\n"
        "from eap.pd.spec import Writer\n"
        "file = open_image(Path(sys.argv[1]))\n"
        "file.acquire_writer(Writer.APPLICATION)\n"
        "print('holding', flush=True)\n"
        "sys.stdin.read()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(files["left"].path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    ) as program:
        assert program.stdout.readline() == b"holding\n"
        error = refusal(methods, "write", {"station": "left", "values": {"running": True}})
        assert error.code == ErrorCode.REFUSED
        assert f"process {program.pid}" in str(error)
        program.stdin.close()
    assert call(methods, "write", {"station": "left", "values": {"running": True}})["written"] == 1


def test_watch_by_period_has_all_values_and_by_change_the_changed(methods, files):
    image = files["left"].image
    params = {"station": "left", "names": ["running", "name"]}
    always = methods.watch(params)
    changes = methods.watch({**params, "on": "change", "period_ms": 10})
    assert (always.period_ms, changes.period_ms) == (500, 10)
    start = {"running": False, "name": "abc"}
    assert always.next_event().values == start
    assert changes.next_event().values == start
    assert changes.next_event() is None
    with image.writing(Writer.APPLICATION):
        image.write("running", True)
    assert always.next_event().values == {"running": True, "name": "abc"}
    assert changes.next_event().values == {"running": True}


def test_watch_event_counts_skipped_cycles(methods, files):
    image = files["left"].image
    params = {"station": "left", "names": ["running"]}
    always = methods.watch(params)
    changes = methods.watch({**params, "on": "change"})

    def run_until(cycle: int) -> None:
        image.words[StationWord.CYCLE] = image.words[StationWord.FUTEX] = cycle

    run_until(10)
    assert (always.next_event().skipped, changes.next_event().skipped) == (0, 0)
    run_until(11)
    assert (always.next_event().skipped, changes.next_event()) == (0, None)
    run_until(21)
    assert (always.next_event().skipped, changes.next_event()) == (9, None)
    run_until(24)
    with image.writing(Writer.APPLICATION):
        image.write("running", True)
    assert (always.next_event().skipped, changes.next_event().skipped) == (2, 11)


def test_read_while_a_cycle_runs_brings_values_of_the_cycle_that_is_named(methods, files):
    image = files["left"].image
    image.words[StationWord.CYCLE] = image.words[StationWord.FUTEX] = 4
    copies = []

    class Running:
        """Words of an engine that runs cycle 5 as soon as somebody has looked at the counter."""

        def __getitem__(self, index: int) -> int:
            value = image.words[index]
            if index == StationWord.CYCLE and not copies:
                copies.append(value)
                image.words[StationWord.CYCLE] = 5
                with image.writing(Writer.ENGINE):
                    image.write("ticks", 5)
                image.words[StationWord.FUTEX] = 5
            return value

        def __len__(self) -> int:
            return len(image.words)

    live = methods._image("left")
    words, live.words = live.words, Running()
    try:
        read = call(methods, "read", {"station": "left", "names": ["ticks"]})
    finally:
        live.words = words
    assert (read["cycle"], read["values"]) == (5, {"ticks": 5})


def test_a_watch_is_checked_when_it_begins(methods):
    with pytest.raises(ControlError, match="shortest is 10"):
        methods.watch({"station": "left", "period_ms": 1})
    with pytest.raises(ControlError, match="unknown station"):
        methods.watch({"station": "middle"})
    with pytest.raises(ControlError, match="did you mean name"):
        methods.watch({"station": "left", "names": ["nam"]})


def test_watch_survives_a_new_configuration(methods, files, stations):
    some = methods.watch({"station": "left", "names": ["running", "name"]})
    all_of_them = methods.watch({"station": "left"})
    more = (*stations[0].variables, VariableSpec("more", "UINT"))
    with create_image(files["left"].path, plan_layout(replace(stations[0], variables=more))):
        assert some.next_event().values == {"running": False, "name": "abc"}
        assert "more" in all_of_them.next_event().values
    fewer = tuple(each for each in stations[0].variables if each.name != "running")
    without = replace(stations[0], variables=fewer, frames=())
    with create_image(files["left"].path, plan_layout(without)):
        with pytest.raises(ControlError, match="no variable 'running'"):
            some.next_event()
        assert "running" not in all_of_them.next_event().values
