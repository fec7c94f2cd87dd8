from __future__ import annotations

import pytest

from eap.ads.endpoint import Endpoint
from eap.ams.record import Traffic
from eap.ams.report import RouteReport, RouteState, advise
from eap.codec.ads import AdsError
from eap.ids import NetId
from tests.support.aoerouter import FAR, ROUTER, route

TARGET, OWN = NetId.parse(FAR), NetId.parse(ROUTER)
HOP = Endpoint("udp:eap0", "10.0.0.6:34980")
UP = RouteReport(route(FAR, HOP, "island"), RouteState.UP, "", 1, Traffic(), "island")
DOWN = UP._replace(state=RouteState.DOWN, why="it does not answer")


def test_answers_are_answers() -> None:
    assert advise(0, TARGET, UP, OWN, is_own=False)[:2] == (True, "answers")
    found = advise(AdsError.TARGET_PORT, TARGET, UP, OWN, is_own=False)
    assert found[:2] == (True, "is there; error 0x6 (nothing has that AMS port)")


CLIENT = UP._replace(state=RouteState.CLIENT, why="not listening: refused")
BEYOND = DOWN._replace(next_name="near")


@pytest.mark.parametrize(
    ("error", "report", "text", "hint"),
    [
        (7, None, f"there is no route to {FAR}", "eapctl routes add"),
        (0x1B, DOWN, f"island ({HOP}) is down: it does not answer", "in the same network"),
        (0x1B, BEYOND, f"near ({HOP}) is down: it does not answer", "in the same network"),
        (0x1B, CLIENT, f"island ({HOP}) is a client, not listening: refused", "nothing is wrong"),
        (0x1B, UP, f"the way is cut behind island ({HOP})", "eapctl trace"),
        (0x719, UP, f"no answer from island ({HOP}) in time", f"add one to {ROUTER}"),
        (7, UP, f"island ({HOP}) knows no way to {FAR}", f"needs a route to {FAR}"),
        (0x723, UP, "access rules forbid to ask for its state", "under access in the plant"),
    ],
)
def test_what_is_wrong_is_told_with_what_to_do(
    error: int, report: RouteReport | None, text: str, hint: str
) -> None:
    found = advise(error, TARGET, report, OWN, is_own=False)
    assert (found.is_reached, found.text) == (False, text)
    assert hint in found.hint


def test_other_errors_are_told_as_they_are() -> None:
    found = advise(0x701, TARGET, UP, OWN, is_own=False)
    assert found.text == (
        f"island ({HOP}) or somebody behind it answers: error 0x701 (it does not know that service)"
    )
    found = advise(4, TARGET, None, OWN, is_own=True)
    assert found.text.startswith("this station itself answers: error 0x4")
