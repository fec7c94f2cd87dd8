from __future__ import annotations

import logging

import pytest

from eap.control.log import AREAS
from eap.errors import ControlError
from eap.services.control.log_methods import LogMethods


@pytest.fixture(autouse=True)
def loggers():
    names = ["", "eap", "eap.net", *(f"eap.services.{area}" for area in AREAS)]
    before = {name: logging.getLogger(name).level for name in names}
    logging.getLogger().setLevel(logging.INFO)
    yield
    for name, level in before.items():
        logging.getLogger(name).setLevel(level)


def call(method: str, **params: str) -> dict[str, str]:
    return LogMethods().table()[method](params).levels


def test_log_level_of_an_area_changes_its_lines_alone(caplog):
    assert set(call("log_levels").values()) == {"info"}
    assert call("set_log_level", level="debug", area="routing") == {
        **dict.fromkeys(AREAS, "info"),
        "routing": "debug",
    }
    logging.getLogger("eap.services.routing.station_router").debug("late")
    logging.getLogger("eap.services.gateway.gateway").debug("unheard")
    assert [record.getMessage() for record in caplog.records] == ["late"]


def test_log_level_of_all_areas_replaces_those_of_some():
    call("set_log_level", level="debug", area="net")
    assert set(call("set_log_level", level="warning").values()) == {"warning"}
    assert not logging.getLogger("eap.net.mqtt").isEnabledFor(logging.INFO)


@pytest.mark.parametrize(
    ("params", "reason"),
    [
        ({"level": "debug", "area": "rooting"}, "unknown area 'rooting', did you mean routing?"),
        ({"level": "debug", "area": "x"}, "known areas: ads, control, "),
        ({"level": "loud"}, "Invalid enum value 'loud'"),
    ],
)
def test_wrong_log_level_is_refused(params, reason):
    with pytest.raises(ControlError, match=reason.replace("?", r"\?")):
        call("set_log_level", **params)
