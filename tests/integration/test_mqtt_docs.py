"""docs/mqtt.md: its examples run, and its broker allows the listed topics only."""

from __future__ import annotations

import doctest
import re

import pytest

from tests.support.mosquitto import broker, write_certificates, write_passwords
from tests.support.mqtthalls import BROKER, NORTH, ROOT, SOUTH, read, until_read, write_plant

pytest.importorskip("pyads", reason="needs pyads: pip install pyads")

pytestmark = [pytest.mark.net, pytest.mark.mosquitto]

PAGE = ROOT / "docs" / "mqtt.md"
TIMEOUT = 0x719


def test_mqtt_page_broker_rights_allow_listed_topics_only(farm, tmp_path):
    """North may ask south, and not the other way round."""
    users = {f"{NORTH}.1.1": "n", f"{SOUTH}.1.1": "s", "5.23.91.23.1.1": "e"}
    files = write_certificates(tmp_path, BROKER)
    text = (ROOT / "config" / "mosquitto" / "plant.conf").read_text()
    for name, file in (
        ("certs/ca.pem", files["ca"]),
        ("certs/broker.pem", files["broker"]),
        ("certs/broker.key", files["broker_key"]),
        ("eap.passwords", write_passwords(tmp_path, **users)),
        ("eap.acl", ROOT / "config" / "mosquitto" / "plant.acl"),
    ):
        text = text.replace(f"/etc/mosquitto/{name}", str(file))
    settings = [line for line in text.splitlines()
                if not line.startswith(("listener", "persistence"))]  # fmt: skip
    with broker(tmp_path / "broker", BROKER, *settings, port=8883):
        for name, address in (("north", NORTH), ("south", SOUTH)):
            user = f"{address}.1.1"
            (tmp_path / user).write_text(f"{users[user]}\n")
            entry = (f'mqtt: "mqtts://{BROKER}", user: {user}, password_file: {user},'
                     " tls: {ca: ca.pem}")  # fmt: skip
            farm.run(write_plant(tmp_path, name, address, broker=entry))
        until_read(SOUTH, SOUTH)
        until_read(SOUTH, by=NORTH)
        assert read(NORTH, SOUTH) == -TIMEOUT


def test_mqtt_page_examples_run(farm, tmp_path):
    settings = (ROOT / "config" / "mosquitto" / "open.conf").read_text().splitlines()
    settings.remove(f"listener 1883 {BROKER}")
    (start, commands) = re.findall(r"```sh\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert start == "mosquitto -c config/mosquitto/open.conf\neapctl run config/mqtt.yaml\n"
    with broker(tmp_path, BROKER, *settings):
        plant = farm.run(ROOT / "config" / "mqtt.yaml")
        until_read(SOUTH, by=NORTH)
        run_examples()
        told = [plant.command(*line.split()[1:]) for line in commands.splitlines()]
    routes, trace, scan = told
    assert re.search(r"north +south +127.0.5.2.\*.\* +mqtt:works +127.0.5.2.1.1 +up", routes)
    for line in re.findall(
        r"^ .*(?:south: mqtt|local target|RUN).*$", PAGE.read_text(), re.MULTILINE
    ):
        assert without_times(line) in without_times(trace)
    assert 'pyads.Connection("127.0.5.2.3.1", 1001, "127.0.5.1")' in scan


def run_examples() -> None:
    test = doctest.DocTestParser().get_doctest(PAGE.read_text(), {}, PAGE.name, PAGE.name, 0)
    told: list[str] = []
    flags = doctest.NORMALIZE_WHITESPACE
    result = doctest.DocTestRunner(optionflags=flags).run(test, out=told.append)
    assert not result.failed, "".join(told)
    assert result.attempted == 6


def without_times(text: str) -> str:
    return re.sub(r"\s+", " ", re.sub(r"[0-9.]+ (?:µs|ms|s)\b", "", text))


def test_mqtt_page_rights_equal_the_example_file():
    rights = (ROOT / "config" / "mosquitto" / "plant.acl").read_text().splitlines()
    page = PAGE.read_text()
    for line in rights:
        if line.startswith(("pattern", "user 127", "topic write works/127")):
            assert f"\n{line}\n" in page
