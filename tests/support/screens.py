"""Screens of the live view, driven by keys without a terminal."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

from textual.app import App
from textual.pilot import Pilot
from textual.widgets import Input

from tests.support.virtualtime import run_virtual

Script = Callable[["Screen"], Awaitable[None]]


class Screen:
    """An app that runs on a screen of *size*, columns and lines."""

    def __init__(self, pilot: Pilot[None]) -> None:
        self.pilot = pilot
        self.app = pilot.app

    async def press(self, *keys: str) -> str:
        """Press keys one after the other, and return what is on the screen when all is done."""
        await self.pilot.press(*keys)
        return await self.settle()

    async def press_key(self, key: str) -> str:
        """Press a key of an app with a worker that never ends, and return what is shown then."""
        await self.pilot.press(key)
        return await self.settle_screen()

    async def settle_screen(self) -> str:
        """Return what is on the screen when all messages are handled, whatever workers do."""
        await self.pilot.pause()
        await self.pilot.pause()
        return self.text()

    async def write(self, text: str) -> str:
        """Paste *text* into the field that has the focus."""
        field = self.app.focused
        assert isinstance(field, Input), field
        field.insert_text_at_cursor(text)
        return await self.settle()

    async def click(self, selector: str, **more: object) -> str:
        await self.pilot.click(selector, **more)
        return await self.settle()

    async def settle(self) -> str:
        await self.app.workers.wait_for_complete()
        await self.pilot.pause()
        await self.app.workers.wait_for_complete()
        await self.pilot.pause()
        return self.text()

    def text(self) -> str:
        strips = self.app.screen._compositor.render_strips()
        return "\n".join(strip.text.rstrip() for strip in strips)


def play(
    app: App[None], script: Script, size: tuple[int, int] = (80, 24), *, is_virtual: bool = False
) -> None:
    """Run *script* on *app*; with *is_virtual* one without threads and sockets, in no time."""

    async def run() -> None:
        async with app.run_test(size=size) as pilot:
            screen = Screen(pilot)
            await screen.settle_screen()
            await script(screen)

    if is_virtual:
        run_virtual(run())
    else:
        asyncio.run(run())
