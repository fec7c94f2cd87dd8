"""docs/routes.md: its commands print the shown output, its screens match."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator

import pytest

from eap.cli.routes_tui.table import RouterClient
from eap.ops.routing import list_routes
from tests.support.appliance import wait_until
from tests.support.liveviews import routes_app
from tests.support.pages import ROOT, Shell, commands, shell
from tests.support.screens import Screen, play

pytestmark = pytest.mark.net

PAGE = (ROOT / "docs" / "routes.md").read_text()
BLOCK = re.compile(r"```(xml|console|text)\n(.*?)```", re.DOTALL)
KEYS = [("down", "t", "escape"), ("down", "down", "t")]
"""Keys pressed before each screen of the page."""


def outline(text: str) -> str:
    """Reduce an output to what is the same in every run."""
    text = re.sub(r"\d+(\.\d+)? (µs|ms|s|min)\b", "TIME", text)
    text = re.sub(r"\d\d:\d\d:\d\d", "CLOCK", text)
    text = re.sub(r":3\d{4}(?=: TIME)", ":PORT", text)
    text = re.sub(r"(?<![\w.:-])\d+(\.\d+)?k?(?![\w.:-])", "N", text)
    text = re.sub(r"─+", "─", text)
    return "\n".join(" ".join(line.split()) for line in text.splitlines())


@pytest.fixture
def reader(monkeypatch: pytest.MonkeyPatch) -> Iterator[Shell]:
    with shell(COLUMNS="100") as made:
        (made.folder / "config").symlink_to(ROOT / "config")
        monkeypatch.setenv("EAP_RUNTIME_DIR", str(made.folder / "run"))
        yield made


def screen_after(keys: tuple[str, ...]) -> str:
    """Return what the live view shows on 80 columns and 24 lines after some keys."""
    shown = []

    async def script(screen: Screen) -> None:
        for key in keys:  # a message comes when its request is answered
            await screen.press(key)
        shown.append(screen.text())

    play(routes_app(RouterClient(None)), script)
    return "\n".join(line.rstrip() for line in shown[0].splitlines()) + "\n"


def routes_are_known() -> bool:
    rows = [row for each in list_routes(None, None) for row in each.stations]
    return all(route.state != "unknown" for row in rows for route in row.routes) and all(
        len(row.connections) == len(rows) - 1 for row in rows
    )


def slaves_answer(reader: Shell) -> bool:
    stations = json.loads(reader.run("eapctl status --json"))["stations"]
    buses = [port["bus"] for each in stations for port in each["ports"] if "bus" in port]
    return all(slave["state"] for bus in buses for slave in bus["slaves"])


def replay(reader: Shell) -> Iterator[tuple[str, str, str]]:
    """Yield what is done, what the page says comes of it, and what does."""
    keys = iter(KEYS)
    for kind, text in BLOCK.findall(PAGE):
        if kind == "xml":
            (reader.folder / "StaticRoutes.xml").write_text(text)
        elif kind == "text":
            pressed = next(keys)
            yield f"keys {pressed}", text, screen_after(pressed)
        else:
            for command, expected in commands(text):
                yield command, expected, reader.run(command)
                if command.endswith(" &"):
                    wait_until(routes_are_known)
                    wait_until(lambda: slaves_answer(reader))


def test_routes_page_commands_and_screens_match(reader: Shell) -> None:
    for command, expected, found in replay(reader):
        assert outline(found) == outline(expected), f"{command}\n{found}"
