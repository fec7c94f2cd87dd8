"""Something that the master does for somebody, from outside."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

from devicebus.errors import BusError
from eap.errors import EapError

T = TypeVar("T")


def _nothing() -> None:
    """There is nothing to stop any more."""


class Task(Generic[T]):
    """A procedure or a conversation that runs.

    Args:
        name: What it does, for messages.
        stop: Ends what is behind it, for :meth:`cancel`.
    """

    def __init__(self, name: str, stop: Callable[[], None]) -> None:
        self.name = name
        self.error: EapError | None = None
        self._stop = stop
        self._value: list[T] = []
        self._watchers: list[Callable[[Task[T]], None]] = []

    @property
    def is_done(self) -> bool:
        """Whether there is a result or an error."""
        return bool(self._value) or self.error is not None

    def result(self) -> T:
        """Return what came out, or raise what went wrong.

        Raises:
            BusError: it still runs, or was cancelled.
        """
        if self.error is not None:
            raise self.error
        if not self._value:
            raise BusError(f"{self.name} is not done yet")
        return self._value[0]

    def watch(self, callback: Callable[[Task[T]], None]) -> None:
        """Call back once it is done, at once if it already is."""
        if self.is_done:
            callback(self)
        else:
            self._watchers.append(callback)

    def cancel(self) -> None:
        """End it where it stands; nothing more is sent for it.  Harmless when it is done."""
        if not self.is_done:
            self._stop()
            self.fail(BusError(f"{self.name} was cancelled"))

    def finish(self, value: T) -> None:
        """It has a result: for whoever runs it."""
        self._value.append(value)
        self._tell()

    def fail(self, error: EapError) -> None:
        """It went wrong: for whoever runs it."""
        self.error = error
        self._tell()

    def _tell(self) -> None:
        self._stop = _nothing  # whoever is behind it knows the task: this would be a circle
        watchers, self._watchers = self._watchers, []
        for callback in watchers:
            callback(self)
