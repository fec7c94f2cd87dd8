from __future__ import annotations

import io
import os
from pathlib import Path

import pytest
from rich.console import Console
from rich.text import Text

from eap.cli.output import Column, TextTable, repaint, write_json, write_text, write_view
from eap.errors import EnvironmentalError


def test_json_is_one_line(capfd: pytest.CaptureFixture[str]) -> None:
    write_json({"name": "µ", "values": [1, None]})
    assert capfd.readouterr().out == '{"name":"µ","values":[1,null]}\n'


def test_text_is_flushed_at_once(capfd: pytest.CaptureFixture[str]) -> None:
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
    write_view([wide_table(), Text("word " * 400)])
    *table, text = capfd.readouterr().out.splitlines()
    assert table[-1] == "x" * 150 + "  [red]y[/red]"
    assert text.count("word") == 400


def test_tables_obey_columns(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    write_view([wide_table()])
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


def repaint_on_terminal(parts: list[Text], monkeypatch: pytest.MonkeyPatch, height: int) -> str:
    written = io.StringIO()
    console = Console(file=written, width=40, height=height, force_terminal=True)
    monkeypatch.setattr("eap.cli.output._console", lambda: console)
    monkeypatch.setattr(
        "eap.cli.output.write_text", lambda text, end="\n": written.write(text + end)
    )
    repaint(parts)
    return written.getvalue()


def test_repaint_overwrites_the_screen_without_scrolling(monkeypatch: pytest.MonkeyPatch) -> None:
    shown = repaint_on_terminal([Text("one"), Text("two")], monkeypatch, 5)
    assert shown == "\x1b[Hone\x1b[K\ntwo\x1b[K\n\x1b[J"


def test_repaint_cuts_lines_that_exceed_the_screen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shown = repaint_on_terminal([Text("\n".join("abcdef"))], monkeypatch, 5)
    assert shown == "\x1b[Ha\x1b[K\nb\x1b[K\nc\x1b[K\n… 3 more lines\x1b[K\n\x1b[J"


def test_repaint_writes_blocks_when_piped(capfd: pytest.CaptureFixture[str]) -> None:
    repaint([Text("one")])
    repaint([Text("two")])
    assert capfd.readouterr().out == "one\n\ntwo\n\n"
