"""Golden octets decode to the fields that their source gives, and encode to the same octets."""

from __future__ import annotations

import struct

import pytest

from devicebus.wire.datagram import (
    Command,
    Datagram,
    DatagramHeader,
    encode_frame,
    iter_datagrams,
)
from eap.codec import ams, amsdiscovery, mailbox, pd, secureads
from eap.codec.ethercat import EtherCatHeader, FrameType
from eap.codec.wire import WireStruct
from eap.errors import TruncatedError
from tests.support.vectors import FOLDER, Vector, load_all, load_datagrams

FRAMES = [v for v in load_all("ethernet", "frame") if not v.error]
MESSAGES = load_all("mailbox")
PACKETS = load_all("ams")
DISCOVERIES = load_all("ams_discovery")
SECURE = load_all("secure_ads")


def by_name(vectors: list[Vector]) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("vector", vectors, ids=lambda vector: vector.name)


def of_type(frame_type: int) -> list[Vector]:
    return [v for v in FRAMES if v.fields["type"] == frame_type]


def assert_fields(record: WireStruct, fields: dict) -> None:
    for name, value in fields.items():
        found = getattr(record, name)
        assert (found.name if name == "type" else found) == value or str(found) == value, name


@by_name(FRAMES)
def test_frame_header_equals_its_vector(vector: Vector) -> None:
    header = EtherCatHeader.decode(vector.frame)
    assert (header.type, header.length) == (vector.fields["type"], vector.fields["length"])
    assert header.encode() == vector.frame[:2]


@by_name(of_type(FrameType.PROCESS_DATA))
def test_process_data_equals_its_vector(vector: Vector) -> None:
    header = pd.decode_frame_header(vector.frame)
    names = ("publisher", "count", "cycle", "reserved", "eap_sm")
    assert_fields(header, {name: vector.fields[name] for name in names})
    pds = [(record, bytes(data)) for record, data in pd.iter_pds(vector.frame)]
    found = [
        {
            "id": record.pd_id,
            "version": record.version,
            "length": record.length,
            "quality": record.quality,
            "data": data.hex(),
        }
        for record, data in pds
    ]
    assert found == vector.fields["pds"]
    assert pd.encode_frame(header, pds) == vector.frame[: vector.fields["length"] + 2]


def assert_message(header: mailbox.MailboxHeader, data: memoryview, fields: dict) -> None:
    fields = dict(fields)
    content = fields.pop("data", None)
    packet = fields.pop("ams", None)
    detail = fields.pop("detail", None)
    assert_fields(header, fields)
    if packet:
        assert_packet(data, packet)
    else:
        assert data.hex() == content
    if detail is not None:
        reply = mailbox.MailboxErrorReply.decode(data)
        assert reply == mailbox.MailboxErrorReply(detail=detail)
        assert reply.encode() == data


def assert_packet(octets: memoryview, fields: dict) -> None:
    header, data = ams.decode_packet(octets)
    fields = dict(fields)
    assert data.hex() == fields.pop("data")
    assert_fields(header, fields)
    assert ams.encode_packet(header, data) == octets[: ams.AmsHeader.SIZE + len(data)]


@by_name(of_type(FrameType.MAILBOX))
def test_mailbox_frame_equals_its_vector(vector: Vector) -> None:
    header, data = mailbox.decode_frame(vector.frame)
    assert_message(header, data, vector.fields["mailbox"])
    assert mailbox.encode_frame(header, data) == vector.frame[: vector.fields["length"] + 2]


@by_name(MESSAGES)
def test_mailbox_message_equals_its_vector(vector: Vector) -> None:
    header, data = mailbox.decode_message(vector.octets)
    assert_message(header, data, vector.fields)
    assert mailbox.encode_message(header, data) == vector.octets


@by_name(of_type(FrameType.AMS))
def test_ams_frame_equals_its_vector(vector: Vector) -> None:
    assert_packet(memoryview(vector.frame)[2:], vector.fields["ams"])


@by_name(PACKETS)
def test_ams_packet_equals_its_vector(vector: Vector) -> None:
    header, data = ams.decode_packet(vector.octets)
    assert_fields(header, vector.fields)
    assert ams.encode_packet(header, data) == vector.octets


@by_name(of_type(FrameType.DATAGRAM))
def test_datagram_frame_equals_its_vector(vector: Vector) -> None:
    datagrams = list(iter_datagrams(vector.frame))
    found = [
        {name: getattr(d.header, name) for name in ("index", "adp", "ado", "length", "irq")}
        | {"command": d.header.command.name, "wkc": d.wkc, "data": bytes(d.data).hex()}
        for d in datagrams
    ]
    assert found == vector.fields["datagrams"]
    assert encode_frame(datagrams) == vector.frame[: vector.fields["length"] + 2]


@by_name([v for v in FRAMES if v.fields["type"] not in list(FrameType)])
def test_undocumented_type_keeps_its_octets(vector: Vector) -> None:
    assert vector.fields["type"] == 7
    assert vector.frame[2 : 2 + vector.fields["length"]].hex() == vector.fields["data"]


def test_message_that_its_source_cut_off_is_truncated() -> None:
    (cut,) = [v for v in load_all("frame") if v.error]
    with pytest.raises(TruncatedError, match="length 256"):
        mailbox.decode_frame(cut.octets)


@pytest.mark.parametrize("fields", [pytest.param(item, id=name) for name, item in load_datagrams()])
def test_datagram_equals_its_capture(fields: dict) -> None:
    data = bytes.fromhex(fields["data"])
    command = Command[fields["command"]]
    header = DatagramHeader(command, fields["index"], fields["adp"], fields["ado"], len(data))
    frame = encode_frame([Datagram(header, data, fields["wkc"])])
    assert frame == struct.pack("<H", 0x1000 | len(frame) - 2) + struct.pack(
        "<BBHHHH", command, fields["index"], fields["adp"], fields["ado"], len(data), 0
    ) + data + struct.pack("<H", fields["wkc"])
    ((read, read_data, wkc),) = iter_datagrams(frame)
    assert (read, bytes(read_data), wkc) == (header, data, fields["wkc"])


@by_name(DISCOVERIES)
def test_discovery_datagram_equals_its_vector(vector: Vector) -> None:
    read = amsdiscovery.decode_discovery(vector.octets)
    assert_fields(read.header, vector.fields["header"])
    assert [[tag, data.hex()] for tag, data in read.tags] == vector.fields["tags"]
    assert amsdiscovery.encode_discovery(read.header, read.tags) == vector.octets


@by_name(SECURE)
def test_secure_ads_message_equals_its_vector(vector: Vector) -> None:
    read = secureads.decode_connect_info(vector.octets)
    fields = vector.fields
    login = (bytes.fromhex(fields["user"]), bytes.fromhex(fields["password"]))
    expected = secureads.ConnectInfo(
        *(read.net_id, fields["flags"], fields["host"], fields["error"]),
        *(*login, fields["version"]),
    )
    assert read == expected
    assert str(read.net_id) == fields["net_id"]
    if not vector.name.endswith("refusal"):  # which has surplus bytes
        assert read.encode() == vector.octets


def test_every_file_is_used() -> None:
    all_used = FRAMES + MESSAGES + PACKETS + DISCOVERIES + SECURE
    used = {v.name.partition("/")[0] for v in all_used} | {"type1_datagrams"}
    assert used == {path.stem for path in FOLDER.glob("*.yaml")}
