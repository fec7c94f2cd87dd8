"""Renderer of ``eapctl``, and the parts of a text view: tables, styled text, values.

Each command hands its result to :class:`Renderer`: ``--json`` prints the encoded record, else
the lines and tables of the command's view.  Results go to stdout, everything else to stderr.  A
reader of stdout may stop early (``| head``): that ends the command quietly and counts as done.

A table leaves out columns before it breaks a word.  Each column has a rank.  Where the table is
wider than the screen, the columns of the highest rank go first, and a line below the table names
them.  Columns that wrap break only at spaces.  Piped output has no width, so that nothing is
left out there.

Rich is imported when something is rendered: a command with ``--json`` never waits for it.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Self, TypeAlias, TypeVar

import click

from eap.errors import EnvironmentalError

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
    from rich.text import Text


CommandT = TypeVar("CommandT", bound=Callable[..., Any])
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


def json_option(text: str) -> Callable[[CommandT], CommandT]:
    """Return the decorator that adds ``--json``; the function gets *output*.

    Args:
        text: Help text: the form of the JSON result.
    """
    return click.option("--json", "output", is_flag=True, callback=_to_output, help=text)


def _to_output(ctx: click.Context, param: click.Parameter, is_json: bool) -> Renderer:
    del ctx, param
    return Renderer(is_json=is_json)


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
    # dup2 keeps the descriptor number, which the interpreter flushes at its end.
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def write_view(view: View) -> None:
    """Print lines and tables, coloured and fitted to the screen only on a terminal.

    Lines without a style are printed as they are, each as soon as it is there.
    """
    console: Console | None = None
    # Each part is printed at once, so that a long listing appears while it is read.
    for part in (view,) if isinstance(view, str) else view:
        if isinstance(part, str):
            write_text(part)
        else:
            console = console or _console()
            write_text(_render(console, [part]), end="")


def repaint(parts: Iterable[RenderableType]) -> None:
    """Print rich renderables over the content of the screen; piped, as a block of lines.

    Each line overwrites that of the time before, so that nothing flickers; what exceeds the screen
    is cut off, and a line says so.
    """
    console = _console()
    text = _render(console, parts)
    if not console.is_terminal:
        write_text(text)
        return
    lines = text.rstrip("\n").split("\n")
    max_lines = console.height - 1  # one line stays free for the prompt of the shell
    if (hidden := len(lines) - max_lines) > 0:
        # A line too many would scroll the screen, and the next repaint would leave its rest above.
        lines[max_lines - 1 :] = [f"… {hidden + 1} more lines"]
    write_text(_HOME + "".join(f"{line}{_CLEAR_LINE}\n" for line in lines) + _CLEAR_BELOW, end="")


def _console() -> Console:
    from rich.console import Console

    console = Console(highlight=False, emoji=False, markup=False)
    # Rich assumes 80 columns for a pipe; a program that reads the output needs every column.
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = UNLIMITED
    return console


def _render(console: Console, parts: Iterable[RenderableType]) -> str:
    with console.capture() as capture:
        for part in parts:
            console.print(part)
    text = capture.get()
    # Rich pads cells to the width of their column; piped lines are compared and parsed.
    if console.is_terminal:
        return text
    return "\n".join(line.rstrip() for line in text.split("\n"))


_GAP = 2
"""Spaces between two columns: what rich puts there for one space of padding and no border."""
_SHOWN_CHARACTERS = 48
"""Length at which the text of a value is cut."""
_LEAST_WRAPPED = 16
"""A column that wraps is not made narrower than this while another one can be left out."""


@dataclass(frozen=True, slots=True)
class Column:
    """One column of a table.

    Attributes:
        heading: Its words above the rows.
        rank: 0 is always shown; a narrow screen omits the highest rank first.
        is_number: Its cells are aligned to the right.
        wraps: Its cells may take several lines, broken at spaces.
    """

    heading: str
    rank: int = 0
    is_number: bool = False
    wraps: bool = False


class Styled:
    """Text with a style for each of its parts, such as ``bold red``."""

    def __init__(self, text: str = "", style: str = "") -> None:
        self._whole_style = style
        self._parts: list[tuple[str, str]] = [(text, "")]

    @property
    def plain(self) -> str:
        """The text without its styles."""
        return "".join(text for text, _ in self._parts)

    @property
    def style(self) -> str:
        """Style of the whole text."""
        return self._whole_style

    def append(self, text: str, style: str = "") -> Self:
        """Add *text* in a style of its own."""
        self._parts.append((text, style))
        return self

    def __rich__(self) -> Text:
        from rich.text import Text

        whole = Text(style=self._whole_style)
        for text, style in self._parts:
            whole.append(text, style or None)
        return whole


class TextTable:
    """Rows below headings, as wide as they need and at most as wide as the screen."""

    def __init__(self, *columns: Column | str) -> None:
        self._columns = [Column(each) if isinstance(each, str) else each for each in columns]
        self._rows: list[list[Styled]] = []

    def add_row(self, *cells: str | Styled) -> None:
        """Add one row; cells that are not given are empty."""
        row = [Styled(cell) if isinstance(cell, str) else cell for cell in cells]
        self._rows.append(row + [Styled()] * (len(self._columns) - len(row)))

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        from rich import box
        from rich.table import Table

        shown = self._fitting(options.max_width)
        widths = self._widths(shown, options.max_width)
        table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, show_edge=False)
        for at, width in zip(shown, widths, strict=True):
            column = self._columns[at]
            table.add_column(
                column.heading,
                width=width,
                justify="right" if column.is_number else "left",
                overflow="fold",
                vertical="top",
            )
        for row in self._rows:
            table.add_row(*(row[at] for at in shown))
        yield table
        if len(shown) < len(self._columns):
            left_out = (each.heading for at, each in enumerate(self._columns) if at not in shown)
            names = ", ".join(" ".join(heading.split()) for heading in left_out)
            yield Styled(f"not shown for lack of width: {names}", style="dim")

    def _fitting(self, max_width: int) -> list[int]:
        """Return the numbers of the columns that fit in *max_width* without breaking words."""
        shown = list(range(len(self._columns)))
        while _total(self._needs(at, "narrow") for at in shown) > max_width:
            worst = max(shown, key=lambda at: self._columns[at].rank)
            if not self._columns[worst].rank:
                break
            shown.remove(worst)
        return shown

    def _widths(self, shown: Sequence[int], max_width: int) -> list[int]:
        """Return the width of each column; those that wrap share the rest."""
        least = [self._needs(at, "narrow") for at in shown]
        widths = [self._needs(at, "wide") for at in shown]
        excess = _total(widths) - max_width
        while excess > 0:
            slack = [wide - narrow for wide, narrow in zip(widths, least, strict=True)]
            widest = max(range(len(shown)), key=lambda at: (slack[at] > 0, widths[at]))
            if not slack[widest]:
                least = [1] * len(shown)  # nothing fits: break words of the widest column
                if widths[widest] == 1:
                    break
                continue
            widths[widest] -= 1
            excess -= 1
        return widths

    def _needs(self, at: int, size: Literal["narrow", "wide"]) -> int:
        """Return the width of a column on one line a cell, or of its longest word if it wraps."""
        from rich.cells import cell_len

        column = self._columns[at]
        texts = [column.heading, *(row[at].plain for row in self._rows)]
        whole = max(cell_len(line) for text in texts for line in text.splitlines() or [""])
        if size == "wide" or not column.wraps:
            return whole
        word = max((cell_len(word) for text in texts for word in text.split()), default=0)
        return max(word, min(whole, _LEAST_WRAPPED))


def _total(widths: Iterable[int]) -> int:
    listed = list(widths)
    return sum(listed) + _GAP * (len(listed) - 1)


class ItemLine:
    """A heading and items behind it, with commas between them; a line ends between two items."""

    def __init__(self, heading: str, items: Sequence[Styled]) -> None:
        self._heading = heading
        self._items = items

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        from rich.text import Text

        line = Text(self._heading, style="bold")
        for number, item in enumerate(each.__rich__() for each in self._items):
            comma = "," if number + 1 < len(self._items) else ""
            if line.cell_len + item.cell_len + 1 + len(comma) > options.max_width:
                yield line
                line = Text(" " * len(self._heading))
            line.append(" ").append_text(item).append(comma, "none")
        yield line


def value_text(value: Any) -> str:
    """Return a value of a variable as text; a long one is cut."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:.7g}"  # the precision of a REAL
    if isinstance(value, list):
        value = f"[{', '.join(map(value_text, value))}]"
    if isinstance(value, dict):
        value = f"{{{', '.join(f'{name}: {_member_text(each)}' for name, each in value.items())}}}"
    text = str(value)
    return (
        text
        if len(text) <= _SHOWN_CHARACTERS
        else f"{text[:_SHOWN_CHARACTERS]}… ({len(text)} characters)"
    )


def _member_text(value: Any) -> str:
    from eap.codec.literals import write_literal

    return write_literal(value) if isinstance(value, str) else value_text(value)


def offset_text(bit_offset: int) -> str:
    """Return an offset in bytes, with the bit behind a dot if it is not 0."""
    offset, bit = divmod(bit_offset, 8)
    return f"{offset}.{bit}" if bit else str(offset)
