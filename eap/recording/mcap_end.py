"""Index and summary of an MCAP file, made of what is in it."""

from __future__ import annotations

from typing import Any

from eap.recording.mcap_file import MAGIC, McapFile

# isort: split
# Behind mcap_file, which says how to install mcap.
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    MessageIndex,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)


def end_of_file(content: McapFile) -> tuple[int, bytes]:
    """Return the size of the data to keep, and the bytes to put behind it.

    The index of the last chunk is made anew: it may be cut.
    """
    keep = content.whole_until
    builder: Any = RecordBuilder()
    if content.chunks:
        last = content.chunks[-1]
        # The index of the last chunk may be cut off: it is made anew of the messages.
        if last.offset + last.length + last.index_length == content.whole_until:
            keep = last.offset + last.length
            last.index_offsets.clear()
            by_channel: dict[int, list[tuple[int, int]]] = {}
            for message in content.messages(last):
                by_channel.setdefault(message.channel, []).append((message.time_ns, message.offset))
            for channel, records in by_channel.items():
                last.index_offsets[channel] = keep + builder.count
                MessageIndex(channel_id=channel, records=records).write(builder)
            last.index_length = builder.count
    # 0 says that there is no checksum: the file would have to be read as a whole for it.
    DataEnd(data_section_crc=0).write(builder)
    data = builder.end()
    return keep, data + _summary(content, keep + len(data)) + MAGIC


def _summary(content: McapFile, start: int) -> bytes:
    builder: Any = RecordBuilder()
    offsets = []
    groups: list[tuple[Opcode, list[Any]]] = [
        (
            Opcode.SCHEMA,
            [
                Schema(id=number, name=each.name, encoding=each.encoding, data=each.data)
                for number, each in content.schemas.items()
            ],
        ),
        (
            Opcode.CHANNEL,
            [
                Channel(
                    id=number,
                    topic=each.topic,
                    message_encoding=each.encoding,
                    metadata=each.metadata,
                    schema_id=each.schema,
                )
                for number, each in content.channels.items()
            ],
        ),
        (Opcode.STATISTICS, [_statistics(content)]),
        (Opcode.CHUNK_INDEX, _chunk_indexes(content)),
        (
            Opcode.ATTACHMENT_INDEX,
            [
                AttachmentIndex(
                    offset=each.offset,
                    length=each.length,
                    create_time=each.created_ns,
                    log_time=each.log_ns,
                    data_size=len(each.data),
                    name=each.name,
                    media_type=each.media_type,
                )
                for each in content.attachments
            ],
        ),
        (
            Opcode.METADATA_INDEX,
            [
                MetadataIndex(offset=each.offset, length=each.length, name=each.name)
                for each in content.metadata
            ],
        ),
    ]
    for code, records in groups:
        first = builder.count
        for record in records:
            record.write(builder)
        if records:
            offsets.append(
                SummaryOffset(
                    group_opcode=code,
                    group_start=start + first,
                    group_length=builder.count - first,
                )
            )
    offsets_start = start + builder.count
    for offset in offsets:
        offset.write(builder)
    # A checksum of 0 says that there is none.
    Footer(summary_start=start, summary_offset_start=offsets_start, summary_crc=0).write(builder)
    summary: bytes = builder.end()
    return summary


def _chunk_indexes(content: McapFile) -> list[Any]:
    return [
        ChunkIndex(
            message_start_time=chunk.first_ns,
            message_end_time=chunk.last_ns,
            chunk_start_offset=chunk.offset,
            chunk_length=chunk.length,
            message_index_offsets=chunk.index_offsets,
            message_index_length=chunk.index_length,
            compression=chunk.compression,
            compressed_size=chunk.data_size,
            uncompressed_size=chunk.uncompressed_size,
        )
        for chunk in content.chunks
    ]


def _statistics(content: McapFile) -> Any:
    counts: dict[int, int] = {}
    for chunk in content.chunks:
        for channel, count in chunk.counts.items():
            counts[channel] = counts.get(channel, 0) + count
    return Statistics(
        attachment_count=len(content.attachments),
        channel_count=len(content.channels),
        channel_message_counts=counts,
        chunk_count=len(content.chunks),
        message_count=sum(counts.values()),
        message_start_time=min((each.first_ns for each in content.chunks), default=0),
        message_end_time=max((each.last_ns for each in content.chunks), default=0),
        metadata_count=len(content.metadata),
        schema_count=len(content.schemas),
    )
