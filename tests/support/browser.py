"""A browser for tests of the page: Debian's Chromium, driven by playwright."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

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


@contextmanager
def browser() -> Iterator[Browser]:
    """Start one browser; root may not have its sandbox."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        found = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), chromium_sandbox=False, args=FLAGS
        )
        try:
            yield found
        finally:
            found.close()


class Tab:
    """A tab of a browser of its own, without cookies of others.

    Attributes:
        page: The tab.
        complaints: Messages of its console, errors of scripts, violations of the content policy.
    """

    def __init__(self, browser: Browser, url: str, **context: Any) -> None:
        self.url = url
        self.complaints: list[str] = []
        self._context = browser.new_context(
            **{"locale": "en-GB", "viewport": {"width": 1280, "height": 800}} | context
        )
        self._context.set_default_timeout(TIMEOUT_MS)
        self._context.add_init_script(_REPORT)
        self.page: Page = self._context.new_page()
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
        """Close it."""
        self._context.close()
