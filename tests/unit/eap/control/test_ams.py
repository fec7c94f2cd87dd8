from __future__ import annotations

import pytest

from eap.ams.report import HopReport
from eap.ams.spec import AccessService
from eap.control.protocol import parameters
from eap.control.routes import AskParameters, hop_row
from eap.errors import ControlError


def test_a_hop_as_a_row() -> None:
    report = HopReport(station="a", net_id="5.1.1.1.1.1", may={AccessService.WRITE: None})
    row = hop_row(report, 12, 7, is_opaque=False)
    assert (row.station, row.took_us, row.spent_us) == ("a", 12, 7)
    assert row.may == {"write": None}


def test_limits_of_a_request() -> None:
    asked = parameters({"target": "x", "command": 2}, AskParameters)
    assert (asked.data, asked.timeout_ms, asked.via) == ("", 5000, "")
    with pytest.raises(ControlError, match="<= 60000"):
        parameters({"target": "x", "command": 2, "timeout_ms": 60_001}, AskParameters)
