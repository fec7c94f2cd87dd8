from __future__ import annotations

import os
from pathlib import Path

import pytest
from rich.text import Text

from eap.cli.output import write_json, write_tables, write_text
from eap.cli.table import Column, TextTable
from eap.errors import EnvironmentalError


def test_json_is_one_line(capfd: pytest.CaptureFixture[str]) -> None:
    write_json({"name": "µ", "values": [1, None]})
    assert capfd.readouterr().out == '{"name":"µ","values":[1,null]}\n'


def test_text_goes_out_at_once(capfd: pytest.CaptureFixture[str]) -> None:
    write_text("a", end="")
    assert capfd.readouterr() == ("a", "")


def wide_table() -> TextTable:
    table = TextTable("a", Column("b", rank=1))
    table.add_row("x" * 150, "[red]y[/red]")
    return table


def test_piped_tables_are_never_cut(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    write_tables([wide_table(), Text("word " * 400)])
    *table, text = capfd.readouterr().out.splitlines()
    assert table[-1] == "x" * 150 + "  [red]y[/red]"
    assert text.count("word") == 400


def test_tables_obey_columns(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    write_tables([wide_table()])
    assert max(map(len, capfd.readouterr().out.splitlines())) == 80


def test_a_reader_that_left_ends_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as closed:
        monkeypatch.setattr("sys.stdout", closed)
        with pytest.raises(SystemExit) as end:
            write_text("a")
    assert end.value.code == 0


def test_stdout_that_is_full_is_an_error_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    with Path("/dev/full").open("w") as full:
        monkeypatch.setattr("sys.stdout", full)
        with pytest.raises(EnvironmentalError, match="stdout cannot be written: No space left"):
            write_text("a")
