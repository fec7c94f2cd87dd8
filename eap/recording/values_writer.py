"""MCAP files of values: one channel a station, one message a cycle, events of the recorder.

The file has, beside the messages of :mod:`eap.recording.messages`:

- metadata ``eap``: format, plant, host, release, options of the command;
- attachments: the files of the plant, and ``published.json`` (:mod:`eap.recording.published`);
- channel ``eap_events``: JSON, one :class:`~eap.recording.header.RecordingEvent` each;
- metadata of each station's channel: its variables with their types and units.

Messages are compressed in chunks of at most a second, so that a killed recorder loses no more.  The
module imports mcap, which is an extra of this project.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import msgspec

from eap.errors import EnvironmentalError
from eap.recording.header import FORMAT, EventKind, RecordingEvent, RecordingHeader
from eap.recording.messages import PlacedVariable, StationMessages
from eap.recording.published import encode_published
from eap.recording.repair import lock
from eap.release import RELEASE

try:
    from mcap.writer import CompressionType, Writer
except ImportError:
    raise EnvironmentalError(
        "recordings of values need mcap, which is not installed: pip install"
        " 'eap-appliance[record]' (in the project's folder: pip install '.[record]')"
    ) from None

HEADER = "eap"
"""Name of the metadata that the file begins with."""
VARIABLES, STATION = "variables", "station"
"""Metadata of a channel."""
EVENTS = "eap_events"
"""Topic of the events."""
PUBLISHED = "published.json"
"""Attachment with the PDs of the plant."""
_EVENT_SCHEMA = {
    "type": "object",
    "properties": {
        "time_ns": {"type": "integer"},
        "kind": {"type": "string"},
        "text": {"type": "string"},
        "station": {"type": "string"},
        "count": {"type": "integer"},
    },
}
_CHUNK_NS = 900_000_000
_CHUNK_BYTES = 1 << 20


class ValuesWriter:
    """One file that is being written; not for several threads.

    Args:
        path: A file that does not exist yet.
        header: Origin of the recording.

    Attributes:
        lost: Cycles that were reported as lost.
        messages: Messages of stations so far.

    Raises:
        OSError: the file cannot be made or written, also from all other methods.
    """

    def __init__(self, path: Path, header: RecordingHeader) -> None:
        self.lost = 0
        self.messages = 0
        self._file = path.open("xb")
        lock(self._file)
        # Any, because mcap annotates some of its methods only.
        self._writer: Any = Writer(self._file, _CHUNK_BYTES, CompressionType.ZSTD)
        self._stations: list[StationMessages] = []
        self._chunk_until_ns = 0
        writer = self._writer
        writer.start(profile="", library=f"eap-appliance {RELEASE}")
        facts = {
            "format": FORMAT,
            "plant": header.plant,
            "host": header.host,
            "release": RELEASE,
            "started_ns": str(header.started_ns),
        }
        # First of all: a recorder that is killed leaves a file that says what it is.
        writer.add_metadata(HEADER, facts | header.options)
        published = encode_published(header.published)
        self._attach(header.started_ns, PUBLISHED, "application/json", published)
        for each in header.files:
            self._attach(header.started_ns, each.name, "application/yaml", each.content)
        schema = writer.register_schema(
            "eap.Event", "jsonschema", msgspec.json.encode(_EVENT_SCHEMA)
        )
        self._events = writer.register_channel(EVENTS, "json", schema)
        self._file.flush()

    def add_station(self, station: str, variables: list[PlacedVariable], topic: str = "") -> int:
        """Return the number of *station*, whose samples have *variables* at these places.

        *topic* is the name of its channel, if that is not the station's.
        """
        messages = StationMessages(station, variables)
        schema: int = self._writer.register_schema(
            messages.schema_name, "protobuf", messages.descriptor()
        )
        facts = {STATION: station, VARIABLES: msgspec.json.encode(messages.variables).decode()}
        channel: int = self._writer.register_channel(topic or station, "protobuf", schema, facts)
        # The events' channel is the first one.
        assert channel == len(self._stations) + 2  # noqa: S101
        self._stations.append(messages)
        return channel

    def write(self, station: int, cycle: int, time_ns: int, sample: bytes) -> None:
        """Add the values of one cycle, which ran at *time_ns* in Unix time."""
        self.write_message(station, cycle, time_ns, self._stations[station - 2].pack(cycle, sample))

    def write_message(self, station: int, cycle: int, time_ns: int, message: bytes) -> None:
        """Add a message that another recording had, with the same variables."""
        self._make_chunk(time_ns)
        self._writer.add_message(station, time_ns, message, time_ns, cycle & 0xFFFFFFFF)
        self.messages += 1

    def add_event(self, event: RecordingEvent) -> None:
        """Add what happened while recording."""
        self._make_chunk(event.time_ns)
        if event.kind is EventKind.LOST:
            self.lost += event.count
        self._writer.add_message(
            self._events, event.time_ns, msgspec.json.encode(event), event.time_ns
        )

    def flush(self) -> None:
        """Write what is in memory to the file; a recorder without messages calls it, too."""
        self._writer.flush()
        self._chunk_until_ns = 0

    def sync(self) -> None:
        """Have the disk keep what was flushed; it may take long, and another thread may call it."""
        os.fdatasync(self._file.fileno())

    @property
    def size(self) -> int:
        """Bytes of the file so far, without what is in memory."""
        return os.fstat(self._file.fileno()).st_size

    def close(self) -> None:
        """Write the index and close the file."""
        try:
            self._writer.finish()
            self._file.flush()
            self.sync()
        finally:
            self._file.close()

    def abandon(self) -> None:
        """Close the file as a killed recorder leaves it; for a disk that is full."""
        # The buffer is dropped: writing it would fail again.
        descriptor = os.dup(self._file.fileno())
        try:
            self._file.close()
        except OSError:
            pass
        finally:
            os.close(descriptor)

    def _attach(self, time_ns: int, name: str, media_type: str, content: bytes) -> None:
        self._writer.add_attachment(time_ns, time_ns, name, media_type, content)

    def _make_chunk(self, time_ns: int) -> None:
        if time_ns >= self._chunk_until_ns:
            if self._chunk_until_ns:
                self._writer.flush()
            self._chunk_until_ns = time_ns + _CHUNK_NS
