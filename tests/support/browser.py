"""A browser for tests of the page: Debian's Chromium, driven by playwright.

Its headless shell, the same without windows, takes half the processor time.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from playwright.sync_api import Browser, BrowserContext, Page, ViewportSize

FLAGS = [
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
TIMEOUT_MS = 40_000
_REPORT = """addEventListener("securitypolicyviolation",
    (event) => console.error("blocked by the content security policy: " + event.blockedURI));"""


def _program() -> str | None:
    """Return where the browser is, without its windows if it is installed that way."""
    return shutil.which("chromium-headless-shell") or shutil.which("chromium")


@contextmanager
def browser() -> Iterator[Tabs]:
    """Start one browser; root may not have its sandbox."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        found = playwright.chromium.launch(
            executable_path=_program(), chromium_sandbox=False, args=FLAGS
        )
        try:
            yield Tabs(found)
        finally:
            found.close()


class Tabs:
    """Tabs of one browser; those of one language share its process and what it has loaded.

    Args:
        browser: Where they are opened.
    """

    def __init__(self, browser: Browser) -> None:
        self._browser = browser
        self._contexts: dict[str, BrowserContext] = {}

    def make(self, url: str, *, locale: str = "en-GB", **look: Any) -> Tab:
        """Return a tab, without cookies and settings of those that were closed before."""
        if locale not in self._contexts:
            context = self._browser.new_context(locale=locale)
            context.set_default_timeout(TIMEOUT_MS)
            context.add_init_script(_REPORT)
            context.new_page()  # keeps the process
            self._contexts[locale] = context
        return Tab(self._contexts[locale], url, **look)


class Tab:
    """A tab of a browser.

    Args:
        context: Where it is opened.
        url: Of the server.
        viewport: Width and height.
        color_scheme: ``light``, ``dark``, or that of the system.

    Attributes:
        page: The tab.
        complaints: Messages of its console, errors of scripts, violations of the content policy.
    """

    def __init__(
        self,
        context: BrowserContext,
        url: str,
        viewport: ViewportSize | None = None,
        color_scheme: Literal["light", "dark"] | None = None,
    ) -> None:
        self.url = url
        self.complaints: list[str] = []
        self._context = context
        self.page: Page = context.new_page()
        self.page.set_viewport_size(viewport or {"width": 1280, "height": 800})
        if color_scheme is not None:
            self.page.emulate_media(color_scheme=color_scheme)
        self.page.on("console", lambda message: self.complaints.append(message.text))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))

    def open(self, address: str = "") -> Page:
        """Open a view, and wait until it is connected."""
        self.page.goto(f"{self.url}/#/{address}")
        self.page.locator("#link.open").wait_for()
        return self.page

    def log_in(self, user: str, password: str) -> None:
        """Log in by the form."""
        self.open("login")
        self.page.get_by_label("User").fill(user)
        self.page.get_by_label("Password").fill(password)
        self.page.get_by_role("button", name="Log in").click()
        self.page.locator(".who", has_text=user).wait_for()

    def close(self) -> None:
        """Close it, and forget cookies and settings."""
        self.page.evaluate("localStorage.clear()")
        self.page.close()
        self._context.clear_cookies()
