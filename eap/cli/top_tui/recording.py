"""Recordings that the live view starts and ends: of a station, a PD or the port of a bus."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import ClassVar, NamedTuple

from textual import on
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical
from textual.widgets import Button, Input, Static

from eap.cli.dialogs import DialogForm
from eap.live.rows import BusRow, PdFlow, StationRow
from eap.quantities import count
from eap.runtime.recordings import RecordingState


class RecordedThing(NamedTuple):
    """Values of a station or of a PD, or frames of a port, that a row of the view stands for."""

    plant: str
    pattern: str
    kind: str = "values"

    @property
    def file_name(self) -> str:
        """Name for the files."""
        return self.pattern.replace("/", "-")


def thing_of(row: object) -> RecordedThing | None:
    """Return the values or frames of a row, None if it has none."""
    if isinstance(row, StationRow):
        return RecordedThing(row.plant, row.name)
    if isinstance(row, PdFlow):
        return RecordedThing(row.plant, f"{row.station}/{row.name}")
    if isinstance(row, BusRow):
        return RecordedThing(row.plant, f"{row.station}/{row.port}", "frames")
    return None


def find_recording(thing: RecordedThing) -> RecordingState | None:
    """Return the recording of *thing* that runs, if there is one that a command ends."""
    from eap.ops.recorders import list_recordings

    for state in list_recordings(thing.plant):
        is_same = (state.kind, state.options.get("patterns")) == (thing.kind, thing.pattern)
        if is_same and not state.is_over and not state.is_of_plant:
            return state
    return None


def start_recording_of(thing: RecordedThing, target: Path) -> str:
    """Start a recording and return a text about it; raises EapError if it cannot begin."""
    from eap.ops.recorders import start_recording
    from eap.recording.recorder import RecorderOptions

    options = RecorderOptions(
        name="", kind=thing.kind, base="", plant="", folder="", patterns=(thing.pattern,)
    )
    state = start_recording(options, thing.plant, target)
    things = count(state.selected, "variable" if thing.kind == "values" else "port")
    return f"recording {state.name!r}: {things} to {state.files[-1]}\nThe key r ends it."


def end_recording(name: str) -> str:
    """End a recording and return a text about it; raises EapError if it has ended."""
    from eap.ops.recorders import stop_recording

    state = stop_recording(name)
    things = count(state.messages, "message" if state.kind == "values" else "frame")
    lost = f"{state.lost} lost" if state.lost else "none lost"
    return f"recording {state.name!r}: {things}, {lost}; {', '.join(state.files)}"


class RecordForm(DialogForm[str]):
    """The path of a recording; its result is what is recorded, or None if it was cancelled.

    Args:
        thing: Of the recording.
        target: Path at first.
        start: Starts it, in a thread; raises EapError if it cannot begin.
    """

    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape", "leave", "Cancel")]

    def __init__(
        self, thing: RecordedThing, target: Path, start: Callable[[RecordedThing, Path], str]
    ) -> None:
        super().__init__()
        self._thing = thing
        self._target = target
        self._start = start

    def compose(self) -> ComposeResult:
        """Yield the path and the buttons below."""
        ending = "mcap" if self._thing.kind == "values" else "pcapng"
        with Vertical(classes="box"):
            title = f"Record {self._thing.kind} of {self._thing.pattern} to FILE.{ending}"
            yield Static(title, classes="title", markup=False)
            yield Input(str(self._target), id="target", compact=True, select_on_focus=False)
            yield Static("", id="problem", markup=False)
            with Horizontal(classes="buttons"):
                yield Button("Record (enter)", id="start", compact=True)
                yield Button("Cancel (esc)", id="leave", compact=True)

    @on(Input.Submitted)
    @on(Button.Pressed, "#start")
    def begin(self) -> None:
        """Start the recording."""
        target = Path(self.query_one("#target", Input).value.strip())
        self.perform("starting…", partial(self._start, self._thing, target))
