"""What status says of bus ports."""

from __future__ import annotations

import msgspec
import pytest

from eap.appliance.bus_request import BusReport, SlaveReport
from eap.appliance.services.bus.bus_status import bus_document, bus_link


def slave(state, **more):
    row = {"vendor": 1, "product": 2, "revision": 3, "serial": 4, "alias": 0, "target": 8}
    return SlaveReport(station=1001, name="a", state=state, **row, **more)


UP = BusReport(is_up=True, slaves=(slave(8), slave(0, fault="it does not answer")), cycles=7)


@pytest.mark.parametrize(
    ("report", "link"),
    [
        (None, "down"),
        (UP, "up"),
        (BusReport(is_up=True), "up"),
        (BusReport(is_up=True, slaves=(slave(0),)), "down"),
        (BusReport(is_up=False, slaves=(slave(8),)), "down"),
    ],
)
def test_link(report, link):
    assert bus_link(report) == link


def test_document():
    report = msgspec.structs.replace(UP, wkc_errors=1, cycles_lost=2, trip_ns=1999)
    bus = bus_document(report)["bus"]
    assert (bus["is_up"], bus["fault"], bus["cycles"], bus["wkc_errors"]) == (True, "", 7, 1)
    assert (bus["lost"], bus["trip_us"]) == (2, 1)
    assert [each["state"] for each in bus["slaves"]] == ["OP", None]
    assert bus["slaves"][1]["fault"] == "it does not answer"
    assert bus_document(None) == {}
