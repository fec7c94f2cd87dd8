"""Forms; what they do in the live view is shown in test_app."""

from __future__ import annotations

import msgspec

from eap.cli.dialogs import Message, Question
from eap.cli.routes_tui.app import RouteForm, values_of
from eap.cli.routes_tui.table import RouterClient
from eap.errors import ControlError
from tests.support.fakeroutes import ISLAND, PRESS
from tests.support.liveviews import routes_app
from tests.support.screens import play


def run(script):
    play(routes_app(RouterClient(None)), script)


def test_form_for_a_change_begins_with_the_route() -> None:
    assert values_of(PRESS) == {
        "name": "press", "net_id": "5.1.2.3.1.1", "via": "ams-tcp:192.168.1.5:48898", "port": "",
        "octets": "6", "virtual": "", "timeout_ms": 0, "probed": True, "unidirectional": False,
        "replaces": "5.1.2.3.1.1",
    }  # fmt: skip
    behind = msgspec.structs.replace(ISLAND, real="9.1.1.1.1.1")
    found = values_of(behind)
    assert (found["via"], found["port"]) == ("udp:127.0.1.2:34980", "eap0")
    assert (found["net_id"], found["virtual"]) == ("9.1.1.1.1.1", "127.0.1.2.1.1")
    broker = msgspec.structs.replace(PRESS, transport="mqtt:line", address="5.1.2.3.1.1")
    assert values_of(broker)["via"] == "mqtt:line"


def test_form_asks_with_what_is_in_its_fields(runtime) -> None:
    asked = []

    async def script(screen):
        def save(params):
            asked.append(params)
            if len(asked) == 1:
                raise ControlError("no such port", code="value")
            return []

        screen.app.push_screen(RouteForm("A route", {"octets": "6", "replaces": "old"}, save))
        await screen.settle()
        await screen.write("press")
        await screen.press(*["tab"] * 6)
        await screen.write("soon")
        assert "expected a number: invalid literal" in await screen.press("ctrl+s")
        await screen.press(*["backspace"] * 4)
        await screen.write("900")
        shown = await screen.press("tab", "space", "tab", "space")
        assert "[ ] probe the next hop" in shown
        assert "[x] one way only" in shown
        assert "no such port" in await screen.press("ctrl+s")
        assert "A route" not in await screen.click("#save")

    run(script)
    assert asked[0] == asked[1] == {
        "name": "press", "net_id": "", "via": "", "port": "", "octets": 6, "virtual": "",
        "timeout_ms": 900, "probed": False, "unidirectional": True, "replaces": "old",
    }  # fmt: skip


def test_form_is_left_by_mouse(runtime) -> None:
    async def script(screen):
        screen.app.push_screen(RouteForm("A route", {}, lambda _: []))
        assert "A route" in await screen.settle()
        assert "A route" not in await screen.click("#leave")

    run(script)


def test_question_and_message(runtime) -> None:
    answers = []

    async def script(screen):
        for key in ("y", "n", "escape"):
            screen.app.push_screen(Question("Really?"), answers.append)
            await screen.settle()
            assert "Really?" not in await screen.press(key)
        screen.app.push_screen(Question("Really?"), answers.append)
        await screen.settle()
        await screen.click("#no")
        screen.app.push_screen(Message("Said", "[not markup]"))
        assert "[not markup]" in await screen.settle()
        assert "Said" not in await screen.click("Button")

    run(script)
    assert answers == [True, False, False, False]
