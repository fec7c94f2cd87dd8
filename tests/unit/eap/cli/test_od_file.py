"""Dumps, read again."""

from __future__ import annotations

from io import StringIO
from pathlib import Path

import pytest

from eap.cli.od_text import read_file
from eap.errors import ConfigError

TEXT = """\
# a remark

0xD000:07 = UDINT 10000  # Cycle time, us, 0x2710
0x8000:0x10=UINT 0xD000# no remark: no space
0x6000:05 = STRING(255) "speed # 1"  # Name
0x6000:06 = STRING(255) degC  # Unit
  0x6000:07 = STRING(9) ""
0x6000:09 = hex 0000 c07f   # Default
D000 = USINT 5
0xF920:1 = BLOCK(6) 1.2.3.4.5.6
# 0xD000:02 = UINT 4  # PDO length
"""


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "mixer.od"
    path.write_text(text)
    return path


def test_text(tmp_path):
    text = TEXT.replace("# no remark: no space", "")
    assert read_file(written(tmp_path, text)) == [
        (0xD000, 7, (10000).to_bytes(4, "little")),
        (0x8000, 16, b"\0\xd0"),
        (0x6000, 5, b"speed # 1"),
        (0x6000, 6, b"degC"),
        (0x6000, 7, b""),
        (0x6000, 9, bytes.fromhex("0000c07f")),
        (0xD000, 0, b"\5"),
        (0xF920, 1, bytes((1, 2, 3, 4, 5, 6))),
    ]


def test_dump_of_the_version_before_reads_as_it_was_written(tmp_path):
    before = """\
0x8000:09 = UINT 1  # decimal digits
0x8000:0x0A = UINT 2  # from 10 on they said that they are hexadecimal
0x8000:0x10 = UINT 3
0x1A00:01 = UDINT 6000:01/32  # Mapping 0, 0x60000120
"""
    assert read_file(written(tmp_path, before)) == [
        (0x8000, 9, b"\1\0"),
        (0x8000, 10, b"\2\0"),
        (0x8000, 16, b"\3\0"),
        (0x1A00, 1, bytes.fromhex("20010060")),
    ]


def test_json(tmp_path):
    lines = [
        '{"index":53248,"subindex":7,"access":"rw","type":"UDINT","data":"10270000"}',
        '{"index":53248,"subindex":2,"access":"r","data":"0400"}',
        '{"index":53248,"subindex":3,"access":"w","data":null}',
        '{"index":53248,"subindex":4,"data":"01"}',
    ]
    assert read_file(written(tmp_path, "\n".join(lines))) == [
        (0xD000, 7, bytes.fromhex("10270000")),
        (0xD000, 4, b"\1"),
    ]


def test_stdin(monkeypatch):
    monkeypatch.setattr("sys.stdin", StringIO("1:2 = USINT 3\n"))
    assert read_file(Path("-")) == [(1, 2, b"\3")]


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("D000 7 10", "'D000 7 10' is not INDEX:SUB = TYPE VALUE"),
        ("0xD000:x = UINT 1", "such as 0x1018:01"),
        ("0xD000:1 = UNIT 1", "did you mean UINT"),
        ("0xD000:1 = UINT", "'' is not a value of UINT"),
        ("0xD000:1 = UINT 65536", "0 to 65535"),
        ('0xD000:1 = STRING(2) "ab" c', "' c' follows the text"),
        ('0xD000:1 = STRING(2) "ab', "Unterminated string"),
        ("0xD000:1 = hex 1", "hexadecimal"),
        ('{"index": 1}', "not an entry as 'od dump --json' prints it"),
        ('{"index":1,"subindex":1,"data":"x"}', "hexadecimal"),
    ],
)
def test_lines_that_cannot_be_read(tmp_path, line, reason):
    path = written(tmp_path, f"# fine\n{line}\n")
    with pytest.raises(ConfigError) as caught:
        read_file(path)
    assert str(caught.value).startswith(f"{path}:2: ")
    assert reason in str(caught.value)
