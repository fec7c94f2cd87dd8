"""Records of MCAP files, whole ones and those of killed recorders.

The file is walked from record to record without reading the messages, so that an index at its end
is not needed.  The layout of the records is that of the MCAP specification, version 0.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple

from eap.errors import EnvironmentalError, MalformedError
from eap.recording.capture_file import LATEST_NS

try:
    import lz4.frame
    import zstandard
except ImportError:
    raise EnvironmentalError(
        "recordings of values need mcap, which is not installed: pip install"
        " 'eap-appliance[record]' (in the project's folder: pip install '.[record]')"
    ) from None

MAGIC = bytes((137, 77, 67, 65, 80, 48, 13, 10))
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = 2, 3, 4, 5, 6, 7
ATTACHMENT, METADATA, DATA_END = 9, 0x0C, 0x0F
"""Operation codes."""
RECORD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_LARGEST_RECORD = 1 << 28
"""Bytes of a record that is read into memory, and of a chunk that is decompressed."""


class McapSchema(NamedTuple):
    """A schema record."""

    name: str
    encoding: str
    data: bytes


class McapChannel(NamedTuple):
    """A channel record."""

    schema: int
    topic: str
    encoding: str
    metadata: dict[str, str]


class McapMessage(NamedTuple):
    """A message record; *offset* is its place in the decompressed chunk."""

    channel: int
    sequence: int
    time_ns: int
    data: bytes
    offset: int


class McapAttachment(NamedTuple):
    """An attachment record, at *offset* of the file and of *length* bytes there."""

    offset: int
    length: int
    log_ns: int
    created_ns: int
    name: str
    media_type: str
    data: bytes


class McapMetadata(NamedTuple):
    """A metadata record, at *offset* of the file and of *length* bytes there."""

    offset: int
    length: int
    name: str
    values: dict[str, str]


@dataclass(slots=True)
class McapChunk:
    """A chunk record; *counts* are the messages of each channel by the records behind it."""

    offset: int
    length: int
    first_ns: int
    last_ns: int
    uncompressed_size: int
    crc: int
    compression: str
    data_offset: int
    data_size: int
    index_offsets: dict[int, int] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    index_length: int = 0


class RecordFields:
    """RecordFields of one record, read one after another; raises MalformedError at its end."""

    def __init__(self, octets: bytes, name: str) -> None:
        self._octets = octets
        self._name = name
        self._at = 0

    def number(self, code: str) -> int:
        """Read a number by its code of ``struct``."""
        try:
            (number,) = struct.unpack_from(f"<{code}", self._octets, self._at)
        except struct.error:
            raise self._short() from None
        self._at += struct.calcsize(f"<{code}")
        return int(number)

    def octets(self, code: str = "I") -> bytes:
        """Read bytes behind their number."""
        size = self.number(code)
        if self._at + size > len(self._octets):
            raise self._short()
        self._at += size
        return self._octets[self._at - size : self._at]

    def text(self) -> str:
        """Read a text behind its length."""
        return self.octets().decode("utf-8", "replace")

    def mapping(self) -> dict[str, str]:
        """Read texts by texts."""
        inner = RecordFields(self.octets(), self._name)
        found = {}
        while not inner.is_at_end:
            name = inner.text()
            found[name] = inner.text()
        return found

    @property
    def is_at_end(self) -> bool:
        """True if there are no more fields."""
        return self._at >= len(self._octets)

    def _short(self) -> MalformedError:
        return MalformedError("a record is too short", layout=self._name, offset=self._at)


class McapFile:
    """One MCAP file without its messages.

    Attributes:
        path: The file.
        chunks: In the order of the file.
        schemas: By number.
        channels: By number.
        attachments: All of them.
        metadata: All of them.
        is_finished: True if the file has its end; False if its recorder runs or was killed.
        whole_until: Offset behind the last whole record of data.
        damaged_chunks: Offsets of the chunks whose content could not be read so far.

    Raises:
        OSError: the file cannot be read.
        MalformedError: it is no MCAP file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.chunks: list[McapChunk] = []
        self.schemas: dict[int, McapSchema] = {}
        self.channels: dict[int, McapChannel] = {}
        self.attachments: list[McapAttachment] = []
        self.metadata: list[McapMetadata] = []
        self.is_finished = False
        self.damaged_chunks: set[int] = set()
        with path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise MalformedError("no MCAP file", layout=str(path))
            self.whole_until = len(MAGIC)
            self._walk(file, os.fstat(file.fileno()).st_size)
        # Channels stand in the chunk that has their first message.
        for chunk in self.chunks:
            if not self.channels or not chunk.counts or chunk.counts.keys() - self.channels.keys():
                counts: dict[int, int] = {}
                for message in self.messages(chunk):
                    counts[message.channel] = counts.get(message.channel, 0) + 1
                chunk.counts = counts

    def messages(self, chunk: McapChunk) -> Iterator[McapMessage]:
        """Yield the messages of *chunk*; of a damaged one nothing."""
        content = self._content(chunk)
        if content is None:
            self.damaged_chunks.add(chunk.offset)
            return
        at, size = 0, len(content)
        while at + RECORD.size <= size:
            code, length = RECORD.unpack_from(content, at)
            start, end = at + RECORD.size, at + RECORD.size + length
            if end > size:
                self.damaged_chunks.add(chunk.offset)
                return
            if code == MESSAGE and length >= _MESSAGE_HEAD.size:
                channel, sequence, time_ns, _ = _MESSAGE_HEAD.unpack_from(content, start)
                data = content[start + _MESSAGE_HEAD.size : end]
                yield McapMessage(channel, sequence, min(time_ns, LATEST_NS), data, at)
            else:
                self._enter_definition(code, content[start:end])
            at = end

    def _content(self, chunk: McapChunk) -> bytes | None:
        if chunk.uncompressed_size > _LARGEST_RECORD or chunk.data_size > _LARGEST_RECORD:
            return None
        with self.path.open("rb") as file:
            file.seek(chunk.data_offset)
            octets = file.read(chunk.data_size)
        try:
            if chunk.compression == "zstd":
                octets = zstandard.ZstdDecompressor().decompress(
                    octets, max_output_size=chunk.uncompressed_size
                )
            elif chunk.compression == "lz4":
                octets = lz4.frame.decompress(octets)
        except (zstandard.ZstdError, RuntimeError, MemoryError):
            return None
        is_right = len(octets) == chunk.uncompressed_size
        if not is_right or (chunk.crc and zlib.crc32(octets) != chunk.crc):
            return None
        return octets

    def _walk(self, file: BinaryIO, size: int) -> None:
        while len(head := file.read(RECORD.size)) == RECORD.size:
            code, length = RECORD.unpack(head)
            start = self.whole_until + RECORD.size
            # A disk that lost power may have zeros where a record was to be.
            if start + length > size or not code:
                return
            if code == DATA_END:
                file.seek(-len(MAGIC), os.SEEK_END)
                self.is_finished = file.read(len(MAGIC)) == MAGIC
                return
            try:
                self._enter(code, file, start, length)
            except MalformedError:
                return
            self.whole_until = start + length
            file.seek(self.whole_until)

    def _enter(self, code: int, file: BinaryIO, start: int, length: int) -> None:
        name = str(self.path)
        if code == CHUNK:
            self.chunks.append(self._chunk(file, start, length))
        elif code == MESSAGE_INDEX and self.chunks and length >= 6:
            channel, size = struct.unpack("<HI", file.read(6))
            chunk = self.chunks[-1]
            chunk.index_offsets[channel] = start - RECORD.size
            chunk.counts[channel] = size // 16
            chunk.index_length += RECORD.size + length
        # Skipped, not read: the length may be damaged.
        elif length > _LARGEST_RECORD:
            return
        elif code == ATTACHMENT:
            fields = RecordFields(file.read(length), name)
            times = fields.number("Q"), fields.number("Q")
            texts = fields.text(), fields.text()
            offset, whole = start - RECORD.size, RECORD.size + length
            attachment = McapAttachment(offset, whole, *times, *texts, fields.octets("Q"))
            self.attachments.append(attachment)
        elif code == METADATA:
            fields = RecordFields(file.read(length), name)
            offset, whole = start - RECORD.size, RECORD.size + length
            self.metadata.append(McapMetadata(offset, whole, fields.text(), fields.mapping()))
        elif code in {SCHEMA, CHANNEL}:
            self._enter_definition(code, file.read(length))

    def _chunk(self, file: BinaryIO, start: int, length: int) -> McapChunk:
        fields = RecordFields(file.read(min(length, 64)), str(self.path))
        first_ns, last_ns, size = fields.number("Q"), fields.number("Q"), fields.number("Q")
        crc = fields.number("I")
        compression = fields.text()
        data_size = fields.number("Q")
        data_offset = start + _CHUNK_HEAD.size + len(compression) + 8
        if data_offset + data_size > start + length:
            raise MalformedError("a chunk is too short", layout=str(self.path), offset=start)
        return McapChunk(
            start - RECORD.size,
            RECORD.size + length,
            min(first_ns, LATEST_NS),
            min(last_ns, LATEST_NS),
            size,
            crc,
            compression,
            data_offset,
            data_size,
        )

    def _enter_definition(self, code: int, octets: bytes) -> None:
        fields = RecordFields(octets, str(self.path))
        if code == SCHEMA:
            number = fields.number("H")
            self.schemas.setdefault(
                number, McapSchema(fields.text(), fields.text(), fields.octets())
            )
        elif code == CHANNEL:
            number, schema = fields.number("H"), fields.number("H")
            self.channels.setdefault(
                number, McapChannel(schema, fields.text(), fields.text(), fields.mapping())
            )
