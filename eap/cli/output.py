"""The renderer of ``eapctl``: a command's typed result as JSON, or as its text view.

Each command hands its result to :class:`Renderer`: ``--json`` prints the encoded record, else
the lines and tables of the command's view.  Results go to stdout, everything else to stderr.  A
reader of stdout may stop early (``| head``): that ends the command quietly and counts as done.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import click

from eap.errors import EnvironmentalError

if TYPE_CHECKING:
    from rich.console import Console, RenderableType

ResultT = TypeVar("ResultT")
View: TypeAlias = "str | Iterable[RenderableType]"
"""One line, or lines and tables from top to bottom."""

UNLIMITED = 10_000
"""Columns of a table when stdout is no terminal: no cell is wrapped, no column left out."""

_HOME, _CLEAR_LINE, _CLEAR_BELOW = "\x1b[H", "\x1b[K", "\x1b[J"
"""ECMA-48: cursor to the first column of the first line, erase to the end of line, of screen."""


class Renderer:
    """Renderer of one command line.

    Attributes:
        is_json: ``--json`` was given.
    """

    def __init__(self, *, is_json: bool) -> None:
        self.is_json = is_json

    def show(self, result: ResultT, view: Callable[[ResultT], View]) -> None:
        """Print one result: one JSON object, or its text view."""
        if self.is_json:
            write_json(result)
        else:
            write_view(view(result))

    def show_rows(self, rows: Iterable[ResultT], view: Callable[[Iterable[ResultT]], View]) -> None:
        """Print a list of results: a JSON object a line as they come, or one text view of all."""
        if not self.is_json:
            write_view(view(rows))
            return
        for row in rows:
            write_json(row)

    def remark(self, text: str) -> None:
        """Print a line on stderr that is in the JSON result already."""
        if not self.is_json:
            click.echo(text, err=True)


def write_json(document: Any) -> None:
    """Print one JSON value on one line of stdout."""
    import msgspec

    write_text(msgspec.json.encode(document).decode())


def write_text(text: str, *, end: str = "\n") -> None:
    """Print *text* on stdout at once; raise EnvironmentalError if it cannot be written."""
    try:
        click.echo(text + end, nl=False)
    except BrokenPipeError:
        _close_stdout()
        raise SystemExit(0) from None
    except OSError as exc:
        _close_stdout()
        raise EnvironmentalError(f"stdout cannot be written: {exc.strerror}") from None


def _close_stdout() -> None:
    """Discard what is buffered: the interpreter would fail at its end when it flushes that."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def write_view(view: View) -> None:
    """Print lines and tables, coloured and fitted to the screen only on a terminal.

    Lines without a style are printed as they are, each as soon as it is there.
    """
    console: Console | None = None
    for part in (view,) if isinstance(view, str) else view:
        if isinstance(part, str):
            write_text(part)
        else:
            console = console or _console()
            write_text(_render(console, [part]), end="")


def repaint(parts: Iterable[RenderableType]) -> None:
    """Print rich renderables in place of what the screen shows; piped, as a block of lines.

    Each line overwrites that of the time before, so that nothing flickers; what exceeds the screen
    is cut off, and a line says so.
    """
    console = _console()
    text = _render(console, parts)
    if not console.is_terminal:
        write_text(text)
        return
    lines = text.rstrip("\n").split("\n")
    room = console.height - 1  # the cursor rests below, where the shell will go on
    if (hidden := len(lines) - room) > 0:
        lines[room - 1 :] = [f"… {hidden + 1} more lines"]
    write_text(_HOME + "".join(f"{line}{_CLEAR_LINE}\n" for line in lines) + _CLEAR_BELOW, end="")


def _console() -> Console:
    from rich.console import Console

    console = Console(highlight=False, emoji=False, markup=False)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = UNLIMITED
    return console


def _render(console: Console, parts: Iterable[RenderableType]) -> str:
    with console.capture() as capture:
        for part in parts:
            console.print(part)
    text = capture.get()
    if console.is_terminal:
        return text
    return "\n".join(line.rstrip() for line in text.split("\n"))
