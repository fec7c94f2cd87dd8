"""Which device a command means."""

from __future__ import annotations

import pytest

from eap.errors import ControlError
from eap.ops.od_devices import Target, open_device


@pytest.mark.parametrize("text", ["mixer", "mixer/eap0", "mixer/bus0/drive", "mixer/bus0/1001"])
def test_od_target_is_read_by_its_parts(text):
    assert str(Target.parse(text)) == text
    assert tuple(Target.parse(text)) == (*(*text.split("/"), "", "")[:3], None)


@pytest.mark.parametrize("text", ["", "/", "mixer/", "/eap0", "a/b/c/d", "a//c"])
def test_invalid_target_is_refused(text):
    with pytest.raises(ValueError, match="is not STATION, STATION/PORT, STATION/PORT/SLAVE"):
        Target.parse(text)


@pytest.mark.parametrize("text", ["mixer", "mixer/bus0/drive"])
def test_od_target_without_a_plant_is_refused(text, tmp_path, monkeypatch):
    monkeypatch.setenv("EAP_RUNTIME_DIR", str(tmp_path))
    with (
        pytest.raises(ControlError, match="no station mixer runs"),
        open_device(Target.parse(text)),
    ):
        pass
