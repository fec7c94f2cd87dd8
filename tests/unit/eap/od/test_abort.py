from __future__ import annotations

import re
from pathlib import Path

from eap.od.abort import AbortCode, SdoAbortError, name_of


def test_every_code_has_a_text() -> None:
    assert all(name_of(code) != "abort code of the vendor" for code in AbortCode)


def test_unknown_codes_stay_numbers() -> None:
    assert name_of(0x06090099) == "abort code of the vendor"


def test_message_names_object_reason_and_detail() -> None:
    error = SdoAbortError(AbortCode.NO_OBJECT, 0x1018, 1)
    assert str(error) == "0x1018:01: object does not exist (0x06020000)"
    assert str(SdoAbortError(0x06070012, 0x6000, 0, "5 bytes for UDINT")).endswith(
        "data is longer than the entry (0x06070012): 5 bytes for UDINT"
    )
    assert (error.code, error.index, error.subindex) == (0x06020000, 0x1018, 1)


def _named(*folders: str) -> set[str]:
    """Return the codes that the files of *folders* name, the tree's root being the start."""
    root = Path(__file__).resolve().parents[4]
    return {
        name
        for folder in folders
        for file in (root / folder).rglob("*.py")
        if file.name not in {"abort.py", "test_abort.py"}
        for name in re.findall(r"\bAbortCode\.([A-Z_0-9]+)\b", file.read_text())
    }


def test_every_code_that_is_sent_is_provoked_by_a_test_that_names_it():
    assert _named("eap/od", "eap/device", "devicebus") <= _named("tests")
