"""The thread of a recorder that writes files, which may wait for the disk as long as it takes."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from time import time_ns
from typing import TypeAlias

from eap.errors import EapError, describe_os_error
from eap.recording.capture import CapturedBlock, Gap
from eap.recording.files import FileSequence, OpenFile
from eap.recording.header import RecordingEvent
from eap.recording.stores import StoreSequence

QUEUE_BYTES = 128 << 20
"""Bytes that may wait for the disk; a block beyond that is lost, and counted."""
_FLUSH_S = 0.5
"""Time of which a killed recorder, or a machine that stops, loses the data at most."""

Step: TypeAlias = "Callable[[FileSequence | StoreSequence], object]"


class DiskThread:
    """Runs steps on the files of a recording, one after the other.

    Args:
        files: The files; from now on only the thread uses their methods.

    Attributes:
        failure: Reason that the thread has ended by itself; empty while it works.
    """

    def __init__(self, files: FileSequence | StoreSequence) -> None:
        self.failure = ""
        self._files = files
        self._steps: queue.SimpleQueue[tuple[Step, int] | None] = queue.SimpleQueue()
        self._waiting = 0
        self._lock = threading.Lock()
        self._open: OpenFile | None = None
        self._thread = threading.Thread(target=self._run, name="disk")
        self._thread.start()

    def open(self, make: OpenFile, time_ns: int) -> None:
        """Begin the next file, and divide it as the files want it."""
        self._post(lambda files: self._begin(files, make, time_ns))

    def write(self, block: CapturedBlock) -> bool:
        """Write a block; return False if too much waits already, and it is lost."""
        # A disk that hangs must not take all memory of the host.
        if self._waiting + len(block.data) > QUEUE_BYTES:
            return False
        self._post(lambda files: self._write(files, block), len(block.data))
        return True

    def add_gap(self, gap: Gap) -> None:
        """Write what is missing."""
        self._post(lambda files: files.add_gap(gap))

    def add_event(self, event: RecordingEvent) -> None:
        """Write an event."""
        self._post(lambda files: files.add_event(event))

    def close_file(self, time_ns: int) -> threading.Event:
        """End the present file; the event is set when that is done, or cannot be done."""
        done = threading.Event()

        def close(files: FileSequence | StoreSequence) -> None:
            try:
                files.close(time_ns)
            finally:
                done.set()

        self._post(close)
        return done

    def end(self, time_ns: int) -> None:
        """End the present file, and wait for the thread."""
        self.close_file(time_ns)
        self._steps.put(None)
        self._thread.join()

    def _post(self, step: Step, size: int = 0) -> None:
        with self._lock:
            self._waiting += size
        self._steps.put((step, size))

    def _begin(self, files: FileSequence | StoreSequence, make: OpenFile, time_ns: int) -> None:
        self._open = make
        files.open(make, time_ns)

    def _write(self, files: FileSequence | StoreSequence, block: CapturedBlock) -> None:
        if self._open is not None and files.is_due(block.first_ns):
            files.open(self._open, block.first_ns)
        files.write(block)

    def _run(self) -> None:
        flush_ns = 0
        while True:
            try:
                item = self._steps.get(timeout=_FLUSH_S)
            except queue.Empty:
                item = (_flush, 0)
            if item is None:
                return
            step, size = item
            with self._lock:
                self._waiting -= size
            # After a failure only the steps that somebody waits for have an effect.
            try:
                step(self._files)
                if time_ns() >= flush_ns:
                    # Also while blocks come all the time, when get() never times out.
                    flush_ns = time_ns() + int(_FLUSH_S * 1e9)
                    self._files.flush()
            except OSError as exc:
                self.failure = self.failure or describe_os_error(exc)
            except EapError as exc:
                self.failure = self.failure or str(exc)
            except Exception as exc:  # noqa: BLE001  without this thread nothing would be written
                self.failure = self.failure or f"{type(exc).__name__}: {exc}"


def _flush(files: FileSequence | StoreSequence) -> None:
    files.flush()
