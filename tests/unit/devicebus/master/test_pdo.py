from __future__ import annotations

import pytest

from devicebus.errors import MailboxProtocolError
from devicebus.mailbox.conversation import MailboxMessage
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.master.pdo import (
    Pdo,
    PdoEntry,
    ProcessDataChannel,
    channels_from_sii,
    read_channels,
    write_configuration,
)
from devicebus.wire.sii import (
    Sii,
    SiiFixed,
    SiiGeneral,
    SiiPdo,
    SiiPdoEntry,
    SiiPdoHeader,
    SiiSyncManager,
)
from eap.codec.coe import CoeService, SdoResponse, encode_initiate, encode_message
from eap.codec.mailbox import MailboxType
from eap.od.abort import SdoAbortError
from eap.od.slave_config import MappedObject, SlaveConfig
from tests.support.busline import Bench, Line, open_mailbox, segment, slave

MANAGERS = (
    SiiSyncManager(0x1000, 128, 0x26, type=1),
    SiiSyncManager(0x1080, 128, 0x22, type=2),
    SiiSyncManager(0x1100, 0, 0x64, type=3),
    SiiSyncManager(0x1180, 4, 0x20, type=4),
)
SII = Sii(
    fixed=SiiFixed(),
    strings=("lamp",),
    sync_managers=MANAGERS,
    rx_pdos=(
        SiiPdo(
            SiiPdoHeader(0x1600, 2, 2),
            (SiiPdoEntry(0x7000, 1, 1, 1, 1), SiiPdoEntry(0, 0, 0, 0, 7)),
        ),
        SiiPdo(SiiPdoHeader(0x1601, 1, 0xFF), (SiiPdoEntry(0x7000, 2, 0, 6, 16),)),
    ),
)


def test_channels_from_sii_have_the_assigned_pdos():
    outputs, inputs = channels_from_sii(SII)
    entries = (PdoEntry(0x7000, 1, 1, "lamp", 1), PdoEntry(0, 0, 7))
    assert outputs == ProcessDataChannel(2, 0x1100, 0x64, True, (Pdo(0x1600, entries),))
    assert (outputs.size, inputs.size, inputs.pdos, inputs.is_output) == (1, 4, (), False)


def test_channels_from_sii_without_type_use_the_control_byte():
    managers = (
        SiiSyncManager(0x0F00, 1, 0x44),
        SiiSyncManager(0x1000, 2, 0x00),
        SiiSyncManager(0x1080, 0, 0x00),
        SiiSyncManager(0x1100, 64, 0x26),
    )
    found = channels_from_sii(Sii(fixed=SiiFixed(), sync_managers=managers))
    assert [(each.number, each.is_output, each.size) for each in found] == [
        (0, True, 1),
        (1, False, 2),
    ]


def test_read_channels_reads_mapping_and_names_by_coe():
    line = Line(Bench(), segment(slave("a")))
    box = open_mailbox(line)
    sii = Sii(fixed=SiiFixed(), sync_managers=MANAGERS, general=SiiGeneral(coe_sdo=1, coe_info=1))
    outputs, inputs = line.wait(box.converse(read_channels(sii), line.now_ns))
    assert outputs.pdos[0].entries[0] == PdoEntry(0x7000, 1, 1, "out", 1)
    assert inputs.pdos[0].entries == (PdoEntry(0x6000, 1, 1, "in", 1), PdoEntry(0, 0, 7))
    assert (outputs.size, inputs.size) == (1, 1)


def test_read_channels_falls_back_to_the_eeprom():
    line = Line(Bench(), segment(slave("a", inputs=())))
    dictionary = line.segment.slaves[0].device.dictionary
    for index in (0x1C12, 0x1C13):
        if index in dictionary:
            dictionary.remove(index)
    box = open_mailbox(line)
    assert line.wait(box.converse(read_channels(SII), line.now_ns)) == channels_from_sii(SII)


def test_write_configuration_clears_counts_first():
    line = Line(Bench(), segment(slave("a")))
    box = open_mailbox(line)
    empty = SlaveConfig(assignment={2: (), 3: (0x1A00,)})
    line.wait(box.converse(write_configuration(empty, box.sizes), line.now_ns))
    dictionary = line.segment.slaves[0].device.dictionary
    assert dictionary.entry(0x1C12, 0).value == 0
    assert dictionary.entry(0x1C13, 1).value == 0x1A00
    wrong = SlaveConfig(mapping={0x1600: (MappedObject(0x7000, 1, 8),)})
    with pytest.raises(SdoAbortError, match="0x1600:0"):
        line.wait(box.converse(write_configuration(wrong, box.sizes), line.now_ns))


def test_write_configuration_encodes_index_subindex_and_bits():
    writing = write_configuration(
        SlaveConfig(mapping={0x1600: (MappedObject(0x7010, 2, 16),)}), MailboxSizes()
    )
    first = next(writing)
    assert first.request[3:6] == b"\x00\x16\x00"
    answer = encode_message(CoeService.SDO_RESPONSE, b"\x60\x00\x16\x00" + bytes(4))
    second = writing.send(MailboxMessage(MailboxType.COE, answer))
    assert second.request[5:] == b"\x01\x10\x02\x10\x70"


def response(index, subindex, octets):
    body = encode_initiate(
        SdoResponse.UPLOAD, index, subindex, octets, complete=False, max_size=100
    )
    return MailboxMessage(MailboxType.COE, encode_message(CoeService.SDO_RESPONSE, body))


@pytest.mark.parametrize(
    ("replies", "text"),
    [
        ([(0x1C12, 0, b"\xff")], "0x1C12:00 is ff, expected a count up to 254"),
        ([(0x1C12, 0, b"\1\0\0\0")], "0x1C12:00 is 01000000, expected a count"),
        ([(0x1C12, 0, b"\1"), (0x1C12, 1, b"\0")], "0x1C12:01 has 1 bytes, expected 2"),
    ],
)
def test_read_channels_refuses_invalid_lists(replies, text):
    asking = read_channels(SII)
    next(asking)
    for reply in replies[:-1]:
        asking.send(response(*reply))
    with pytest.raises(MailboxProtocolError, match=text):
        asking.send(response(*replies[-1]))
