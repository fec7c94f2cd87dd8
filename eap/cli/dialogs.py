"""Screens that the live views share: a table with a filter, forms, questions, messages."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, TypeVar

import msgspec
from textual import on, work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical
from textual.screen import ModalScreen, Screen
from textual.widgets import Button, Input, Static

from eap.errors import EapError, describe_os_error

ResultT = TypeVar("ResultT")


class FilteredScreen(Screen[None]):
    """A screen with a table, and a field ``#filter`` for its rows that appears while it is used."""

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool:
        """Return whether a key has its action: a slash in a field is a sign."""
        del parameters
        return action != "filter" or not isinstance(self.focused, Input)

    def action_filter(self) -> None:
        """Edit the filter of rows."""
        field = self.query_one("#filter", Input)
        field.display = True
        self.set_focus(field)

    @on(Input.Submitted, "#filter")
    def _leave_filter(self) -> None:
        self.query_one("#filter").display = False
        self.query_one("#table").focus()


class DialogForm(ModalScreen[ResultT]):
    """Fields that stay until their request succeeds; the result is None if the form is left."""

    @on(Button.Pressed, "#leave")
    def action_leave(self) -> None:
        """Close the form without a change."""
        self.dismiss(None)

    def perform(self, shown: str, request: Callable[[], ResultT]) -> None:
        """Make a request, with a text *shown* meanwhile, and close the form with its result."""
        self.show_problem(shown)
        self._perform(request)

    # A request may take seconds; in Textual's own thread the keyboard would freeze.
    @work(thread=True, exclusive=True)
    def _perform(self, request: Callable[[], ResultT]) -> None:
        try:
            result = request()
        except OSError as exc:
            self.app.call_from_thread(self.show_problem, describe_os_error(exc))
        except (EapError, msgspec.MsgspecError) as exc:
            self.app.call_from_thread(self.show_problem, str(exc))
        else:
            self.app.call_from_thread(self.dismiss, result)

    def show_problem(self, text: str) -> None:
        """Show why the form stays."""
        self.query_one("#problem", Static).update(text)


class Question(ModalScreen[bool]):
    """Yes or no; Enter alone is no."""

    # Enter, pressed once too often, must not remove a route.
    AUTO_FOCUS = "#no"
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("y", "answer(True)", "Yes"),
        Binding("n,escape", "answer(False)", "No"),
    ]

    def __init__(self, text: str) -> None:
        super().__init__()
        self._text = text

    def compose(self) -> ComposeResult:
        """Yield the question and two buttons."""
        with Vertical(classes="box"):
            yield Static(self._text, markup=False)
            with Horizontal(classes="buttons"):
                yield Button("Yes (y)", id="yes", compact=True)
                yield Button("No (n)", id="no", compact=True)

    @on(Button.Pressed)
    def answer_by_button(self, event: Button.Pressed) -> None:
        """Answer by a button."""
        self.dismiss(event.button.id == "yes")

    def action_answer(self, is_yes: bool) -> None:
        """Answer by a key."""
        self.dismiss(is_yes)


class Message(ModalScreen[None]):
    """A text with a button to close it."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape,enter,space,q", "app.pop_screen", "Close"),
    ]

    def __init__(self, title: str, text: str) -> None:
        super().__init__()
        self._title = title
        self._text = text

    def compose(self) -> ComposeResult:
        """Yield the text."""
        with Vertical(classes="box"):
            yield Static(self._title, classes="title", markup=False)
            yield Static(self._text, markup=False)
            with Horizontal(classes="buttons"):
                yield Button("Close (esc)", compact=True)

    @on(Button.Pressed)
    def close_by_button(self) -> None:
        """Go back."""
        self.dismiss()
