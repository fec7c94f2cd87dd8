"""Watch over other hosts, some of which run another release."""

from __future__ import annotations

import asyncio
import json
import struct
from typing import Any

import pytest

from eap.codec.ads import AdsError
from eap.codec.ams import CONTROL_PORT, AmsAnswer
from eap.config.plant_sections import HostSection
from eap.ids import NetId
from eap.release import RELEASE
from eap.services.host_watch import PERIOD_S, HostWatch
from tests.support.virtualtime import run_virtual

HOSTS = (
    HostSection(name="a", address="10.0.0.1", stations=("x",)),
    HostSection(name="b", address="10.0.0.2", stations=("y", "z")),
)
NET_IDS = {name: NetId.parse(f"10.0.0.{number}.1.1") for number, name in enumerate("xyz", 1)}
BESIDE, FAR = "0.0.9", "7.3.0"
OLD_HELLO = {"version": 1, "plant": "line", "stations": ["y"]}
"""Answer of the first release, whose ``hello`` had no other fields."""


class Router:
    """Router of a station; *answers* are those of stations, by NetID, or an error code."""

    def __init__(self, **answers: dict[str, Any] | int) -> None:
        self.answers = {NET_IDS[name]: answer for name, answer in answers.items()}
        self.asked: list[NetId] = []

    async def request(
        self, target: NetId, target_port: int, command: int, body: bytes, *, timeout_s: float
    ) -> AmsAnswer:
        assert target_port == CONTROL_PORT
        self.asked.append(target)
        answer = self.answers[target]
        if isinstance(answer, int):
            return AmsAnswer(error_code=answer)
        line = json.dumps({"v": 1, "id": 1, "result": answer}).encode()
        data = struct.pack("<II", 0, len(line)) + line
        return AmsAnswer(struct.pack("<II", 0, len(data)) + data)


def watch_for(seconds: float, router: Any, own: str = "a") -> HostWatch:
    """Return a watch that has served for a time."""
    watch = HostWatch(own, HOSTS, NET_IDS, {"x": router})

    async def run() -> None:
        try:
            async with asyncio.timeout(seconds):
                await watch.serve()
        except TimeoutError:
            pass

    run_virtual(run())
    return watch


def states(watch: HostWatch) -> list[tuple[str, str, str | None]]:
    return [(each["name"], each["release"], each["reason"]) for each in watch.report()]


def test_plant_of_one_host_has_nothing_to_watch() -> None:
    router = Router()
    watch = watch_for(60, router, own="")
    assert (watch.report(), watch.findings(), router.asked) == ([], [], [])


def test_host_that_answers_has_its_release_and_no_finding_if_it_is_the_same() -> None:
    router = Router(y=OLD_HELLO | {"release": RELEASE})
    watch = watch_for(PERIOD_S / 2, router)
    assert states(watch) == [("b", RELEASE, "")]
    assert (watch.findings(), len(router.asked)) == ([], 1)


@pytest.mark.parametrize(
    ("release", "severity", "advice"),
    [
        (BESIDE, "warning", "one release apart, which works: upgrade the older one"),
        (FAR, "error", "more than one release apart: upgrade the older one step by step"),
    ],
)
def test_other_release_is_a_finding(release: str, severity: str, advice: str) -> None:
    later = {"release": release, "host": "b", "field_of_a_later_release": [1]}
    (finding,) = watch_for(PERIOD_S / 2, Router(y=OLD_HELLO | later)).findings()
    assert finding["since"]
    assert finding | {"since": None} == {
        "severity": severity,
        "where": "host b",
        "what": f"runs release {release}, this host {RELEASE}",
        "advice": advice,
        "since": None,
    }


def test_appliance_of_the_first_release_is_known_without_its_release() -> None:
    watch = watch_for(PERIOD_S / 2, Router(y=OLD_HELLO))
    assert (states(watch), watch.findings()) == ([("b", "", "")], [])


def test_other_station_of_a_host_answers_where_the_first_does_not() -> None:
    router = Router(y=AdsError.TARGET_MACHINE, z=OLD_HELLO | {"release": RELEASE})
    assert states(watch_for(PERIOD_S / 2, router)) == [("b", RELEASE, "")]


def test_host_that_goes_away_keeps_its_release_and_has_the_reason() -> None:
    router = Router(y=OLD_HELLO | {"release": BESIDE}, z=AdsError.TIMEOUT)

    class Leaving(Router):
        async def request(self, *args: Any, **kwargs: Any) -> AmsAnswer:
            if self.asked:
                self.answers[NET_IDS["y"]] = AdsError.TIMEOUT
            return await super().request(*args, **kwargs)

    leaving = Leaving()
    leaving.answers = router.answers
    watch = watch_for(PERIOD_S * 1.5, leaving)
    assert states(watch) == [("b", BESIDE, AdsError.words_of(AdsError.TIMEOUT))]
