from __future__ import annotations

from tools.objects import PAGE, render


def test_the_page_of_all_objects_is_what_the_tables_say():
    assert PAGE.read_text() == render()
