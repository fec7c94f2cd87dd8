from __future__ import annotations

import pytest

from eap.codec.soe import SoeErrorCode, name_of


def test_every_code_has_a_text_of_its_own() -> None:
    texts = [name_of(code) for code in SoeErrorCode]
    assert len(set(texts)) == len(texts) == 48
    assert "error code of the vendor" not in texts


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (0x1001, "no such IDN"),
        (0x2004, "name is read only"),
        (0x3002, "attribute is too short"),
        (0x6005, "maximum is write protected now"),
        (0x7003, "value is too long"),
        (0x700A, "value is write protected: it is configured cyclically"),
        (0x7011, "procedure command cannot be interrupted"),
        (0x800A, "invalid drive number"),
        (0x800B, "general error"),
        (0x800C, "no element addressed"),
        (0x9999, "error code of the vendor"),
    ],
)
def test_text(code: int, text: str) -> None:
    assert name_of(code) == text
