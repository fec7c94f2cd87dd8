"""Objects of stations, over the control protocol."""

from __future__ import annotations

from contextlib import ExitStack

import pytest

from eap.errors import ControlError
from eap.od.abort import SdoAbortError
from eap.od.model import OdState
from eap.ops.client import connect_station
from eap.ops.od_devices import StationOd
from tests.support.controlstub import ControlStub
from tests.support.oddevice import MemoryDevice, methods, mixer

pytestmark = pytest.mark.net


@pytest.fixture
def device():
    return MemoryDevice(mixer())


@pytest.fixture
def answers(device):
    return methods(device)


@pytest.fixture
def station(answers, tmp_path, monkeypatch):
    monkeypatch.setenv("EAP_RUNTIME_DIR", str(tmp_path / "run"))
    with ExitStack() as stack:
        ControlStub("line", ["mixer"], answers, stack)
        with connect_station("mixer", None) as client:
            yield StationOd(client, "mixer/eap0")


def test_od_of_station_describes_as_its_device(station, device):
    assert station.objects() == device.objects()
    assert station.describe(0x8000) == device.describe(0x8000)
    assert station.entry(0xD000, 7) == device.entry(0xD000, 7)
    with pytest.raises(SdoAbortError, match="0xD000:08: subindex does not exist"):
        station.entry(0xD000, 8)
    with pytest.raises(ControlError, match="object does not exist"):
        station.entry(0xD001, 7)


def test_read_and_write(station, device):
    station.write(0xD000, 7, b"\1\0\0\0")
    assert station.read(0xD000, 7) == b"\1\0\0\0"
    assert station.read(0xD000, 0, complete=True) == b"\7\0\1\0\0\0"
    assert list(station.contents()) == device.contents()


def test_od_of_station_raises_abort(station):
    with pytest.raises(ControlError, match=r"0x1000:00.*0x06010002") as caught:
        station.write(0x1000, 0, bytes(4))
    assert caught.value.code == "abort"


def test_refusal_because_of_the_state(station, device):
    device.state = OdState.OP
    with pytest.raises(
        ControlError, match="bring it to PREOP first: eapctl state mixer/eap0 PREOP"
    ):
        station.write(0xD000, 7, bytes(4))


def test_a_refused_state_request_needs_no_hint(station, answers):
    def refuse(params):
        raise ControlError("0xF200:01: refused (0x08000022): no PDO", code="abort")

    answers["od_write"] = refuse
    with pytest.raises(ControlError, match=r"no PDO$"):
        station.write(0xF200, 1, b"\x08\0")


def test_refusal_of_another_kind(station, answers):
    def refuse(params):
        raise ControlError("no port eap0", code="unknown_name")

    answers["od_describe"] = refuse
    with pytest.raises(ControlError, match="no port eap0"):
        station.entry(0x1000, 0)


def test_type_of_a_later_release(station, answers):
    row = {"index": 1, "name": "", "label": "", "code": "VAR", "max_subindex": 0}
    entry = {"subindex": 0, "name": "New", "type": "FUTURE", "access": "r", "unit": "", "bits": 16,
             "rights": 7, "default": "", "minimum": None, "maximum": None}  # fmt: skip
    answers["od_describe"] = lambda _: row | {"entries": [entry]}
    assert station.entry(1, 0).kind is None
