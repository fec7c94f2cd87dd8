"""Take a picture of a view of the page, such as those in README.md and docs/web.md.

    make demo    # in another terminal, some minutes before: trends begin empty
    python -m tools.screenshot docs/pictures/page.png http://127.0.0.1:8080/#/page/Line

It needs playwright (``pip install playwright``) and Debian's chromium.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path
from typing import Final

from PIL import Image
from playwright.sync_api import sync_playwright

SETTLED_MS: Final = 5000
"""Time for histories, routes and the first rates after the page has connected."""
_COLORS = 256


def take(
    out: Path, address: str, *, size: tuple[int, int], scheme: str, locale: str, whole: bool
) -> None:
    """Write a PNG with few colours, which is a third as large.

    Args:
        out: The picture.
        address: Address of the view.
        size: Width and height of the window in pixels.
        scheme: ``light`` or ``dark``.
        locale: Language of the browser, such as ``en-GB``.
        whole: Whether the picture is as high as the view, and not as the window.
    """
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), chromium_sandbox=False, args=["--disable-gpu"]
        )
        width, height = size
        context = browser.new_context(
            viewport={"width": width, "height": height},
            color_scheme="dark" if scheme == "dark" else "light",
            locale=locale,
        )
        page = context.new_page()
        page.goto(address)
        page.locator("#link.open").wait_for()
        page.wait_for_timeout(SETTLED_MS)
        page.screenshot(path=out, full_page=whole)
        browser.close()
    with Image.open(out) as image:
        image.convert("RGB").quantize(_COLORS, Image.Quantize.MAXCOVERAGE).save(out, optimize=True)


def main() -> None:
    """Take the picture that the command line describes."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("address")
    parser.add_argument("--size", default="1280x760", help="window in pixels (1280x760)")
    parser.add_argument("--scheme", choices=["light", "dark"], default="light")
    parser.add_argument("--locale", default="en-GB")
    parser.add_argument("--window", action="store_true", help="no more than the window shows")
    arguments = parser.parse_args()
    width, _, height = arguments.size.partition("x")
    take(
        arguments.out,
        arguments.address,
        size=(int(width), int(height)),
        scheme=arguments.scheme,
        locale=arguments.locale,
        whole=not arguments.window,
    )


if __name__ == "__main__":
    main()
