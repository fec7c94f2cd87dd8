"""Entries as lines."""

from __future__ import annotations

import pytest

from eap.cli.od_text import object_lines, value_line
from eap.ops.od import OdValue, OdWholeObject
from tests.support.records import record


def row(kind, data, value=None, name="", unit=""):
    return record(OdValue, index=0x8000, subindex=1, type=kind, data=data, value=value, name=name,
                  unit=unit)  # fmt: skip


@pytest.mark.parametrize(
    ("given", "line"),
    [
        (row("UINT", "0900", 9, "Level", "mm"), "0x8000:01 = UINT 9  # Level, mm"),
        (row("UINT", "0a00", 10, "Level"), "0x8000:01 = UINT 10  # Level, 0xA"),
        (row("INT", "ffff", -1), "0x8000:01 = INT -1"),
        (row("BOOL", "01", value=True), "0x8000:01 = BOOL true"),
        (row("BOOL", "02", value=True), "0x8000:01 = hex 02"),
        (row("STRING(4)", "6122", 'a"'), '0x8000:01 = STRING(4) "a\\""'),
        (row("STRING(4)", "c3a4", "ä"), '0x8000:01 = STRING(4) "ä"'),
        (row("STRING(4)", "ff", "�"), "0x8000:01 = hex ff"),
        (row("REAL", "0000c07f"), "0x8000:01 = REAL nan"),
        (row("REAL", "0100c07f"), "0x8000:01 = hex 0100c07f"),
        (row("UINT", "01"), "0x8000:01 = hex 01"),
        (row(None, "0102", 513), "0x8000:01 = hex 0102  # 0x201"),
    ],
)
def test_values_read_as_they_were(given, line):
    assert value_line(given) == line


def test_whole_object_without_a_description_is_bytes():
    given = record(OdWholeObject, index=0x8000, name="Settings", data="0102")
    assert list(object_lines(given)) == ["# 0x8000 Settings", "hex 01 02  # 2 bytes"]
