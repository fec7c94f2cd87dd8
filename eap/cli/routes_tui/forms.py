"""What the live view asks people: a form for a route, a question, and something to be read."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

from textual import on, work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical
from textual.screen import ModalScreen
from textual.widgets import Button, Checkbox, Input, Label, Static

from eap.control.routes import RouteRow
from eap.errors import EapError

_FIELDS = {
    "name": ("Name", "press"),
    "net_id": ("NetID", "5.1.2.3.1.1; may be empty for a station of the plant"),
    "via": ("Via", "STATION/PORT, ams-tcp:HOST, udp:ADDRESS, mqtt:NETWORK"),
    "port": ("EAP port", "to leave by; may be empty"),
    "octets": ("Octets", "of the NetID that have to match: 4, 5 or 6; 0 for a default route"),
    "virtual": ("Virtual", "NetID that it has here (NAT); may be empty"),
    "timeout_ms": ("Time-out", "of an answer, in ms; may be empty"),
}
_KINDS_WITHOUT_PORT = {"ams-tcp", "mqtt"}


class Tick(Checkbox):
    """A checkbox that shows without colours, too, whether it is ticked."""

    BUTTON_LEFT = "["
    BUTTON_INNER = " "
    BUTTON_RIGHT = "]"

    def watch_value(self) -> None:
        """Show the value."""
        self.BUTTON_INNER = "x" if self.value else " "
        super().watch_value()


class RouteForm(ModalScreen[list[str]]):
    """The fields of a route; it stays until the route is taken, or the form is left.

    It ends with what there is to say against the route, or with None if it was left.

    Args:
        title: What it is about.
        values: Of the fields at first, and ``replaces`` for a route that is to go.
        save: Takes the parameters of ``routes_add``, in a thread, and returns what there is to say
            against them; raises EapError if refused.
    """

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape", "leave", "Cancel"),
        Binding("ctrl+s", "save", "Save"),
    ]

    def __init__(
        self, title: str, values: dict[str, Any], save: Callable[[dict[str, Any]], list[str]]
    ) -> None:
        super().__init__()
        self._title = title
        self._values = values
        self._save = save

    def compose(self) -> ComposeResult:
        """Yield a line for each field, and below them what to do."""
        with Vertical(classes="box"):
            yield Static(self._title, classes="title", markup=False)
            for name, (label, hint) in _FIELDS.items():
                with Horizontal(classes="field"):
                    yield Label(label)
                    value = str(self._values.get(name, "") or "")
                    yield Input(
                        value, placeholder=hint, id=name, compact=True, select_on_focus=False
                    )
            with Horizontal(classes="field"):
                is_probed = bool(self._values.get("probed", True))
                yield Tick("ask whether it is alive", is_probed, id="probed", compact=True)
                is_one_way = bool(self._values.get("unidirectional", False))
                yield Tick("one way only", is_one_way, id="unidirectional", compact=True)
            yield Static("", id="problem", markup=False)
            with Horizontal(classes="buttons"):
                yield Button("Save (^s)", id="save", compact=True)
                yield Button("Cancel (esc)", id="leave", compact=True)

    @on(Button.Pressed, "#leave")
    def action_leave(self) -> None:
        """Change nothing."""
        self.dismiss(None)

    @on(Input.Submitted)
    @on(Button.Pressed, "#save")
    def action_save(self) -> None:
        """Ask for the route."""
        texts = {name: self.query_one(f"#{name}", Input).value.strip() for name in _FIELDS}
        try:
            numbers = {name: int(texts[name] or 0) for name in ("timeout_ms",)}
            numbers["octets"] = int(texts["octets"] or 4)
        except ValueError as exc:
            self._tell(f"a number is expected: {exc}")
            return
        self._tell("asking…")
        self._ask(
            texts
            | numbers
            | {"replaces": self._values.get("replaces", "")}
            | {
                name: self.query_one(f"#{name}", Tick).value
                for name in ("probed", "unidirectional")
            }
        )

    @work(thread=True, exclusive=True)
    def _ask(self, params: dict[str, Any]) -> None:
        try:
            warnings = self._save(params)
        except EapError as exc:
            self.app.call_from_thread(self._tell, str(exc))
        else:
            self.app.call_from_thread(self.dismiss, warnings)

    def _tell(self, text: str) -> None:
        self.query_one("#problem", Static).update(text)


class Question(ModalScreen[bool]):
    """Yes or no; Enter alone is no."""

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
        """Take the button that was pressed for the answer."""
        self.dismiss(event.button.id == "yes")

    def action_answer(self, is_yes: bool) -> None:
        """Take a key for the answer."""
        self.dismiss(is_yes)


class Message(ModalScreen[None]):
    """Something to be read, until a key is pressed."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape,enter,space,q", "app.pop_screen", "Close"),
    ]

    def __init__(self, title: str, text: str) -> None:
        super().__init__()
        self._title = title
        self._text = text

    def compose(self) -> ComposeResult:
        """Yield what there is to read."""
        with Vertical(classes="box"):
            yield Static(self._title, classes="title", markup=False)
            yield Static(self._text, markup=False)
            with Horizontal(classes="buttons"):
                yield Button("Close (esc)", compact=True)

    @on(Button.Pressed)
    def close_by_button(self) -> None:
        """Go back."""
        self.dismiss()


def values_of(row: RouteRow) -> dict[str, Any]:
    """Return what a form for a change of *row* begins with."""
    kind, _, port = row.transport.partition(":")
    address = port if kind == "mqtt" else row.address
    return {
        "name": row.name,
        "net_id": row.real or row.net_id,
        "via": f"{kind}:{address}",
        "port": "" if kind in _KINDS_WITHOUT_PORT else port,
        "octets": str(row.octets),
        "virtual": row.net_id if row.real else "",
        "timeout_ms": row.timeout_ms,
        "probed": row.probed,
        "unidirectional": row.unidirectional,
        "replaces": row.net_id,
    }
