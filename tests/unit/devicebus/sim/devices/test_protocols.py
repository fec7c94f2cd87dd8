"""Mailboxes with the protocols that a description asks for."""

from __future__ import annotations

import pytest

from devicebus.sim.device import Device
from devicebus.sim.devices.build import build_slave
from devicebus.sim.devices.protocols import build_mailbox
from devicebus.sim.spec import DeviceKind, FileSpec, MailboxSpec, SlaveSpec
from devicebus.wire.alstatus import AlState
from eap.codec.foe import FoeErrorCode
from eap.codec.mailbox import MailboxHeader, MailboxType, decode_message, encode_message
from eap.od.dictionary import ObjectDictionary


def make(spec, files=()):
    device = Device("d", ObjectDictionary())
    mailbox = build_mailbox(spec, files, device)
    mailbox.start(spec.size, spec.size)
    return device, mailbox


def ask(mailbox, kind, data):
    mailbox.receive_message(encode_message(MailboxHeader(0, type=kind), data), 0)
    header, body = decode_message(mailbox.next_message(0))
    return header.type, bytes(body)


@pytest.mark.parametrize("kind", [MailboxType.COE, MailboxType.FOE])
def test_protocol_that_is_not_there_is_refused(kind):
    _, mailbox = make(MailboxSpec(coe=False))
    assert ask(mailbox, kind, bytes(10)) == (MailboxType.ERR, b"\1\0\2\0")


def test_file_for_boot_only_and_with_a_password():
    files = (FileSpec(name="fw", content="abc", boot_only=True, password=7),)
    device, mailbox = make(MailboxSpec(foe=True), files)
    request = b"\1\0" + (7).to_bytes(4, "little") + b"fw"
    kind, data = ask(mailbox, MailboxType.FOE, request)
    assert (kind, data[0], int.from_bytes(data[2:6], "little")) == (
        MailboxType.FOE, 5, FoeErrorCode.BOOTSTRAP_ONLY,
    )  # fmt: skip
    device.al_state = AlState.BOOT
    assert ask(mailbox, MailboxType.FOE, request) == (MailboxType.FOE, b"\3\0\1\0\0\0abc")
    kind, data = ask(mailbox, MailboxType.FOE, b"\1\0\0\0\0\0fw")
    assert int.from_bytes(data[2:6], "little") == FoeErrorCode.NO_RIGHTS


def test_dictionary_answers_by_coe():
    _, mailbox = make(MailboxSpec())
    request = bytes.fromhex("0020 40 0010 00 00000000")
    assert ask(mailbox, MailboxType.COE, request) == (
        MailboxType.COE,
        bytes.fromhex("0020 80 0010 00 00000206"),
    )


def test_voe_echoes_and_eoe_answers():
    _, mailbox = make(MailboxSpec(voe=True, eoe=True))
    message = bytes.fromhex("34120000 0500 aabb")
    assert ask(mailbox, MailboxType.VOE, message) == (MailboxType.VOE, message)
    assert ask(mailbox, MailboxType.EOE, bytes.fromhex("06000000"))[0] is MailboxType.EOE


def test_idns_of_a_drive():
    spec = SlaveSpec(name="d", kind=DeviceKind.DRIVE, mailbox=MailboxSpec(soe=True))
    mailbox = build_slave(spec).device.mailbox
    mailbox.start(256, 256)
    read_mode = bytes.fromhex("01 40 2000")
    assert ask(mailbox, MailboxType.SOE, read_mode) == (
        MailboxType.SOE,
        bytes.fromhex("02 40 2000 02000000"),
    )
