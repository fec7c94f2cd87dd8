"""Screens of a terminal become an animated SVG."""

from __future__ import annotations

from xml.etree import ElementTree as ET

import pytest

from tools.screencast import draw

SVG = "{http://www.w3.org/2000/svg}"


def texts(element: ET.Element) -> list[str | None]:
    return [each.text for each in element.findall(f"{SVG}text")]


def test_draw_screens_draws_lines_that_change_in_one_group_a_screen() -> None:
    document = ET.fromstring(draw(["title\n\x1b[1mone\x1b[0m\n", "title\n<two>\n"], 0.5))
    assert texts(document) == ["title"]
    groups = document.findall(f"{SVG}g")
    assert [texts(each) for each in groups] == [["one"], ["<two>"]]
    assert [each.get("style") for each in groups] == [
        "animation-delay:0.00s",
        "animation-delay:0.50s",
    ]


def test_draw_styled_words_keep_their_columns_and_styles() -> None:
    document = ET.fromstring(draw(["  a  \x1b[1;31mred\x1b[0m\n"], 1.0))
    plain, red = document.findall(f"{SVG}text")
    assert (plain.text, plain.get("font-weight"), plain.get("fill")) == ("a", None, None)
    assert (red.text, red.get("font-weight")) == ("red", "bold")
    assert red.get("fill")
    assert float(red.get("x", 0)) - float(plain.get("x", 0)) == pytest.approx(3 * 8.4, abs=0.2)
