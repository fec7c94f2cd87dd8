from __future__ import annotations

from tools.objects import PAGE, render


def test_objects_page_equals_the_tables():
    assert PAGE.read_text() == render()
