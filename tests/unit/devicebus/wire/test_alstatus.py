from __future__ import annotations

import pytest

from devicebus.wire.alstatus import AlStatusCode, name_of, state_name


def test_every_code_used_has_a_text() -> None:
    assert not any(name_of(code).startswith("code ") for code in AlStatusCode)
    assert name_of(0x001B) == "sync manager watchdog"


def test_unknown_codes_are_shown_as_numbers() -> None:
    assert name_of(0x8001) == "code 0x8001 of the vendor"


@pytest.mark.parametrize(
    ("status", "text"),
    [(1, "INIT"), (0x14, "SAFEOP+ERROR"), (8, "OP"), (3, "BOOT"), (0, "state 0")],
)
def test_states_by_name(status: int, text: str) -> None:
    assert state_name(status) == text
