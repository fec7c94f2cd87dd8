from __future__ import annotations

import logging

import pytest

from eap.control.log import AREAS
from eap.errors import ControlError
from eap.runtime.log import LevelFile
from eap.services.control.log_methods import LogMethods


@pytest.fixture(autouse=True)
def loggers():
    names = ["", "eap", "eap.net", *(f"eap.services.{area}" for area in AREAS)]
    before = {name: logging.getLogger(name).level for name in names}
    logging.getLogger().setLevel(logging.INFO)
    yield
    for name, level in before.items():
        logging.getLogger(name).setLevel(level)


@pytest.fixture
def call(tmp_path):
    """Call a method of an appliance that has a page and a bridge."""
    table = LogMethods(LevelFile(tmp_path), lambda: ["web", "mqtt"]).table()
    return lambda method, **params: table[method](params).levels


def test_log_level_of_an_area_changes_its_lines_alone(call, caplog):
    assert set(call("log_levels").values()) == {"info"}
    assert call("set_log_level", level="debug", area="routing") == {
        **dict.fromkeys((*AREAS, "web", "mqtt"), "info"),
        "routing": "debug",
    }
    logging.getLogger("eap.services.routing.station_router").debug("late")
    logging.getLogger("eap.services.gateway.gateway").debug("unheard")
    assert [record.getMessage() for record in caplog.records] == ["late"]


def test_log_level_of_all_areas_replaces_those_of_some(call):
    call("set_log_level", level="debug", area="net")
    assert set(call("set_log_level", level="warning").values()) == {"warning"}
    assert not logging.getLogger("eap.net.mqtt").isEnabledFor(logging.INFO)


@pytest.mark.parametrize(
    ("params", "reason"),
    [
        ({"level": "debug", "area": "rooting"}, "unknown area 'rooting', did you mean routing?"),
        ({"level": "debug", "area": "x"}, "known areas: ads, control, "),
        ({"level": "debug", "area": "mqt"}, "unknown area 'mqt', did you mean mqtt?"),
        ({"level": "loud"}, "Invalid enum value 'loud'"),
    ],
)
def test_wrong_log_level_is_refused(call, params, reason):
    with pytest.raises(ControlError, match=reason.replace("?", r"\?")):
        call("set_log_level", **params)


@pytest.mark.parametrize("content", [b"", b"{", b'{"web": "\xff"}', b'{"web": 5}'])
def test_damaged_file_of_log_levels_is_as_none(tmp_path, content):
    (tmp_path / "log.levels").write_bytes(content)
    levels = LevelFile(tmp_path)
    assert levels.read() == {}
    levels.follow("web")


def test_log_level_of_an_optional_process_is_followed_by_it_alone(call, tmp_path):
    mqtt, logger = LevelFile(tmp_path), logging.getLogger("eap")
    mqtt.follow("mqtt")
    assert logger.getEffectiveLevel() == logging.INFO
    assert call("set_log_level", level="debug", area="mqtt")["mqtt"] == "debug"
    assert call("log_levels")["web"] == "info"
    LevelFile(tmp_path).follow("web")
    assert logger.level == logging.INFO
    mqtt.follow("mqtt")
    assert logger.level == logging.DEBUG
    logger.setLevel(logging.ERROR)
    mqtt.follow("mqtt")
    assert logger.level == logging.ERROR, "an unchanged file is not read again"
    call("set_log_level", level="warning")
    mqtt.follow("mqtt")
    assert logger.level == logging.WARNING


def test_log_levels_begin_with_info_again_and_survive_a_damaged_file(call, tmp_path):
    call("set_log_level", level="debug", area="web")
    table = LogMethods(LevelFile(tmp_path), lambda: ["web"]).table()
    assert table["log_levels"]({}).levels["web"] == "info"
    (tmp_path / "log.levels").write_text("[")
    assert table["log_levels"]({}).levels["web"] == "info"
    LevelFile(tmp_path).follow("web")
