"""Databases that take values as they come: PostgreSQL, and all that read InfluxDB's line protocol.

A :class:`StoreSequence` is to a recorder what a sequence of files is.  Rows are kept until the
store has taken them, so that short breaks cost nothing; what exceeds the memory is lost and
counted.  Nothing here is called by the thread that reads the plant.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from time import monotonic
from typing import Any, NamedTuple, Protocol
from urllib.parse import urlsplit, urlunsplit

from eap.config.record_texts import STORE_SCHEMES
from eap.errors import ConfigError, EnvironmentalError
from eap.pd.layout import ImageLayout
from eap.recording.capture import CapturedBlock, Gap, samples_in
from eap.recording.files import OpenFile
from eap.recording.header import EventKind, RecordingEvent, RecordingHeader
from eap.recording.messages import StationMessages
from eap.recording.rows import ValueColumn, source_of
from eap.recording.sinks import event_of, placed_variables

WAITING_BYTES = 256 << 20
"""Of rows that wait for the store; the oldest are lost beyond that."""
_PAUSE_S = 1.0
"""Between two attempts at a store that does not answer."""
_END_S = 10.0
"""Time for the last rows when the recording ends."""
_ROW_OVERHEAD = 64


class StoreError(Exception):
    """The store did not take rows; *is_final* if it never will."""

    def __init__(self, message: str, *, is_final: bool = False) -> None:
        super().__init__(message)
        self.is_final = is_final


class StoreTable(NamedTuple):
    """Rows of one station: its columns, in the order of the values."""

    station: str
    columns: tuple[ValueColumn, ...]


class StoreRow(NamedTuple):
    """Values of one cycle; *table* is the number of its table."""

    table: int
    time_ns: int
    cycle: int
    values: list[Any]


class Store(Protocol):
    """Connection to one database; all methods raise StoreError."""

    def open(self, plant: str, tables: Sequence[StoreTable]) -> None:
        """Connect if there is no connection, and prepare for *tables* from now on."""

    def write(self, rows: Sequence[StoreRow], events: Sequence[RecordingEvent]) -> None:
        """Store all of them, or raise."""

    def close(self) -> None:
        """Close the connection; raises nothing."""


def check_url(url: str) -> None:
    """Raise ConfigError if *url* is none of a store."""
    parts = urlsplit(url)
    if parts.scheme not in STORE_SCHEMES or not parts.hostname:
        raise ConfigError(
            f"--to {shown_url(url)}: expected a store such as postgresql://host/database,"
            " influx+http://host:8086/api/v2/write?org=o&bucket=b or influx+udp://host:8089"
        )


def shown_url(url: str) -> str:
    """Return *url* without its password."""
    parts = urlsplit(url)
    if parts.password is None:
        return url
    host = parts.netloc.rpartition("@")[2]
    return urlunsplit(parts._replace(netloc=f"{parts.username or ''}:***@{host}"))


def make_store(url: str) -> Store:
    """Return the store at *url*, not connected yet.

    Raises:
        ConfigError: it is no URL of a store.
        EnvironmentalError: an extra is missing.
    """
    check_url(url)
    if url.startswith("postgresql"):
        from eap.recording.postgres import PostgresStore

        return PostgresStore(url)
    from eap.recording.influx import InfluxStore

    return InfluxStore(url)


class StoreSink:
    """Rows for a store, made of captured blocks.

    Args:
        sequence: Where they wait.
        header: Origin of the recording.
        layouts: Of the stations.
        patterns: Of the variables.
    """

    def __init__(
        self,
        sequence: StoreSequence,
        header: RecordingHeader,
        layouts: Sequence[ImageLayout],
        patterns: Sequence[str],
    ) -> None:
        self._sequence = sequence
        self._stations: dict[str, tuple[int, StationMessages]] = {}
        tables: list[StoreTable] = []
        for layout in layouts:
            if variables := placed_variables(layout, patterns):
                messages = StationMessages(layout.station, variables)
                self._stations[layout.station] = len(tables), messages
                tables.append(StoreTable(layout.station, source_of(messages).columns))
        sequence.begin(header.plant, tables)

    def add(self, block: CapturedBlock) -> int:
        """Queue the rows of *block*; return their number."""
        found = self._stations.get(block.source)
        if found is None:
            return 0
        table, messages = found
        count = 0
        for cycle, time_ns, sample in samples_in(block):
            # The same values as in a file: packing knows types and members already.
            _, values = messages.unpack(messages.pack(cycle, sample))
            self._sequence.queue(StoreRow(table, time_ns, cycle, values))
            count += 1
        return count


class StoreSequence:
    """Rows on their way to a store; the methods are those of a sequence of files.

    Args:
        store: The store.
        url: Its URL, for people.
        clock: Returns seconds.

    Attributes:
        messages: Rows that the store has taken.
        lost: Rows that it did not take in time.
        trouble: Reason that rows wait; empty while it takes them.
    """

    def __init__(self, store: Store, url: str, clock: Callable[[], float] = monotonic) -> None:
        self.messages = 0
        self.octets = 0
        self.lost = 0
        self.trouble = ""
        self.paths: list[Path] = []
        self._store = store
        self._url = shown_url(url)
        self._clock = clock
        self._sink: StoreSink | None = None
        self._plant = ""
        self._tables: Sequence[StoreTable] = ()
        self._is_open = False
        self._rows: deque[StoreRow] = deque()
        self._events: list[RecordingEvent] = []
        self._bytes = 0
        self._next_s = 0.0

    @property
    def is_open(self) -> bool:
        """True if the store has answered."""
        return self._is_open

    def open(self, make: OpenFile, time_ns: int) -> None:
        """Prepare for the rows of what *make* opens.

        Raises:
            EnvironmentalError: the store does not answer at the start, or refuses.
        """
        if self._sink is not None:
            self.flush()
        is_first = not self._is_open
        sink = make(Path(), time_ns)
        assert isinstance(sink, StoreSink)  # noqa: S101  recordings to a store make nothing else
        self._sink = sink
        if is_first:
            try:
                self._store.open(self._plant, self._tables)
            except StoreError as exc:
                raise EnvironmentalError(f"{self._url}: {exc}") from None
            self._is_open = True

    def begin(self, plant: str, tables: Sequence[StoreTable]) -> None:
        """Take rows of *tables* from now on; rows of earlier ones that wait are lost."""
        self.lost += len(self._rows)
        self._rows.clear()
        self._bytes = 0
        self._plant, self._tables = plant, tables
        if self._is_open:
            self._try(lambda: self._store.open(plant, tables))

    def is_due(self, time_ns: int) -> bool:
        """Return False: a store has no end."""
        del time_ns
        return False

    def write(self, block: CapturedBlock) -> None:
        """Queue the rows of a block."""
        if self._sink is not None:
            self._sink.add(block)

    def queue(self, row: StoreRow) -> None:
        """Queue one row, and lose the oldest ones if too much waits."""
        self._rows.append(row)
        self._bytes += _size(row)
        while self._bytes > WAITING_BYTES:
            self._bytes -= _size(self._rows.popleft())
            self.lost += 1

    def add_gap(self, gap: Gap) -> None:
        """Queue what is missing."""
        self.add_event(event_of(gap))

    def add_event(self, event: RecordingEvent) -> None:
        """Queue an event."""
        self._events.append(event)
        # Bounded as the rows are, while the store does not answer.
        del self._events[:-1000]

    def flush(self) -> None:
        """Have the store take what waits, unless it failed a moment ago.

        Raises:
            EnvironmentalError: the store refuses the rows for good.
        """
        if (self._rows or self._events) and self._clock() >= self._next_s:
            self._send()

    def close(self, time_ns: int) -> None:
        """Have the store take the last rows; what it does not take within 10 s is lost."""
        del time_ns
        end_s = self._clock() + _END_S
        while self._rows or self._events:
            self._next_s = 0.0
            self.flush()
            if not self.trouble:
                continue
            if self._clock() >= end_s:
                break
            _pause()
        self.lost += len(self._rows)
        self._rows.clear()
        self._events.clear()
        self._bytes = 0
        self._store.close()

    def _send(self) -> None:
        rows, events = list(self._rows), list(self._events)

        def send() -> None:
            self._store.open(self._plant, self._tables)
            self._store.write(rows, events)

        if self._try(send):
            self._rows.clear()
            self._events.clear()
            self._bytes = 0
            self.messages += len(rows)

    def _try(self, step: Callable[[], None]) -> bool:
        try:
            step()
        except StoreError as exc:
            # The connection may be in any state now: the next attempt opens another one.
            self._store.close()
            if exc.is_final:
                raise EnvironmentalError(f"{self._url}: {exc}") from None
            self.trouble = f"{self._url}: {exc}"
            self._next_s = self._clock() + _PAUSE_S
            return False
        self.trouble = ""
        return True


def _size(row: StoreRow) -> int:
    return _ROW_OVERHEAD + 32 * len(row.values)


def _pause() -> None:
    import threading

    threading.Event().wait(0.2)


def lost_texts(events: Sequence[RecordingEvent]) -> list[tuple[int, str, str, str, int]]:
    """Return time, kind, station, text and count of events."""
    return [
        (each.time_ns, str(EventKind(each.kind)), each.station, each.text, each.count)
        for each in events
    ]
