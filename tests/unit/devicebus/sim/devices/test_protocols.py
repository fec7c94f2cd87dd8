"""Mailboxes with the protocols that a description asks for."""

from __future__ import annotations

from ipaddress import IPv4Address

import pytest
from scapy.layers.inet import ICMP, IP
from scapy.layers.l2 import ARP, Ether

from devicebus.mailbox.eoe import FrameAssembler, iter_fragments
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.sim.device import Device
from devicebus.sim.devices.build import build_slave
from devicebus.sim.devices.ethernet_host import mac_of
from devicebus.sim.devices.protocols import build_mailbox
from devicebus.sim.spec import AccessKind, DeviceKind, FileSpec, MailboxSpec, SlaveSpec
from devicebus.wire.alstatus import AlState
from eap.codec.ads import AdsRange
from eap.codec.ams import AmsCommand, AmsHeader, encode_packet
from eap.codec.eoe import EoeType, IpSettings
from eap.codec.eoe import encode_message as encode_eoe
from eap.codec.foe import FoeErrorCode
from eap.codec.mailbox import MailboxHeader, MailboxType, decode_message, encode_message
from eap.ids import MacAddr, NetId
from eap.od.dictionary import ObjectDictionary
from tests.support.bus import generic


def make(spec, files=()):
    device = Device("d", ObjectDictionary())
    mailbox = build_mailbox(spec, files, device, MailboxSizes(spec.size, spec.size))
    mailbox.start(spec.size, spec.size)
    return device, mailbox


def ask(mailbox, kind, data):
    mailbox.receive_message(encode_message(MailboxHeader(0, type=kind), data), 0)
    header, body = decode_message(mailbox.next_message(0))
    return header.type, bytes(body)


@pytest.mark.parametrize("kind", [MailboxType.COE, MailboxType.FOE])
def test_mailbox_without_a_protocol_refuses_it(kind):
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


def foe(mailbox, octets):
    kind, data = ask(mailbox, MailboxType.FOE, octets)
    assert kind is MailboxType.FOE
    return int.from_bytes(data[2:6], "little") if data[0] == 5 else 0


@pytest.mark.parametrize(
    ("rules", "read", "write"),
    [
        ({}, 0, 0),
        ({"access": AccessKind.READ}, 0, FoeErrorCode.ACCESS_DENIED),
        ({"access": AccessKind.WRITE}, FoeErrorCode.ACCESS_DENIED, 0),
        ({"boot_only": True}, FoeErrorCode.BOOTSTRAP_ONLY, FoeErrorCode.BOOTSTRAP_ONLY),
        ({"not_in_boot": True}, 0, 0),
    ],
)
def test_rules_of_files(rules, read, write):
    _, mailbox = make(MailboxSpec(foe=True), (FileSpec(name="f", **rules),))
    assert foe(mailbox, b"\1\0\0\0\0\0f") == read
    assert foe(mailbox, b"\2\0\0\0\0\0f") == write


def test_boot_only_file_is_missing_outside_of_boot():
    device, mailbox = make(MailboxSpec(foe=True), (FileSpec(name="f", not_in_boot=True),))
    device.al_state = AlState.BOOT
    assert foe(mailbox, b"\1\0\0\0\0\0f") == FoeErrorCode.NOT_IN_BOOTSTRAP
    with pytest.raises(ValueError, match="file f exists in no state"):
        make(MailboxSpec(foe=True), (FileSpec(name="f", not_in_boot=True, boot_only=True),))


@pytest.mark.parametrize(
    ("content", "code"),
    [(b"123456789\x26\x39\xf4\xcb", 0), (b"123456789\0\0\0\0", FoeErrorCode.CHECKSUM),
     (b"12", FoeErrorCode.CHECKSUM)],
)  # fmt: skip
def test_file_with_a_check_sum(content, code):
    _, mailbox = make(MailboxSpec(foe=True), (FileSpec(name="f", checksum=True),))
    foe(mailbox, b"\2\0\0\0\0\0f")
    assert foe(mailbox, b"\3\0\1\0\0\0" + content) == code


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


def test_pdos_go_through_the_mailbox():
    slave = build_slave(generic())
    mailbox, dictionary = slave.device.mailbox, slave.device.dictionary
    mailbox.start(256, 256)
    write = bytes.fromhex("0050 3412 01")  # RxPDO 0
    mailbox.receive_message(encode_message(MailboxHeader(0, type=MailboxType.COE), write), 0)
    assert mailbox.next_message(0) is None
    assert (dictionary.entry(0x7000, 1).value, dictionary.entry(0x7000, 2).value) == (0x1234, True)
    assert ask(mailbox, MailboxType.COE, bytes.fromhex("0070")) == (MailboxType.COE, write)
    dictionary.entry(0x6000, 1).value = 0x5678
    assert ask(mailbox, MailboxType.COE, bytes.fromhex("0060")) == (
        MailboxType.COE, bytes.fromhex("0040 7856 00"),
    )  # fmt: skip
    for refused in ("0050 3412", "0150 3412 01", "0160", "0170"):
        assert ask(mailbox, MailboxType.COE, bytes.fromhex(refused))[0] is MailboxType.ERR


def test_dictionary_answers_by_aoe():
    slave = build_slave(generic(mailbox=MailboxSpec(aoe=True)))
    mailbox = slave.device.mailbox
    mailbox.start(256, 256)
    header = AmsHeader(NetId(b"target"), 1001, NetId(b"source"), 33000, AmsCommand.READ)
    request = encode_packet(header, AdsRange(0xF302, 0x1018_0001, 4).encode())
    kind, data = ask(mailbox, MailboxType.AOE, request)
    assert (kind, data[32:]) == (MailboxType.AOE, bytes.fromhex("00000000 04000000 5a0e0000"))
    server = mailbox.protocols[MailboxType.AOE]._handler
    assert server.address is not None
    mailbox.start(256, 256)
    assert server.address is None


def test_every_axis_of_a_drive_has_idns():
    spec = SlaveSpec(name="d", kind=DeviceKind.DRIVE, axes=2, mailbox=MailboxSpec(soe=True))
    slave = build_slave(spec)
    mailbox = slave.device.mailbox
    mailbox.start(256, 256)
    position = (77).to_bytes(4, "little")
    assert ask(mailbox, MailboxType.SOE, bytes.fromhex("23 40 2f00") + position) == (
        MailboxType.SOE, bytes.fromhex("24 40 2f00"),
    )  # fmt: skip
    assert slave.device.dictionary.entry(0x687A, 0).value == 77
    assert slave.device.dictionary.entry(0x607A, 0).value == 0
    assert ask(mailbox, MailboxType.SOE, bytes.fromhex("41 40 2f00"))[1][-2:] == b"\x0a\x80"


def test_device_with_eoe_answers_a_ping_in_fragments():
    _, mailbox = make(MailboxSpec(eoe=True, size=128))
    settings = IpSettings(ip=IPv4Address("10.0.0.2"))
    set_ip = encode_eoe(EoeType.SET_IP_REQUEST, settings.encode())
    assert ask(mailbox, MailboxType.EOE, set_ip)[1][2:4] == b"\0\0"
    assembler = FrameAssembler()
    announced = assembler.receive(bytes(decode_message(mailbox.next_message(0))[1]))
    assert Ether(announced)[ARP].pdst == "10.0.0.2"
    ping = IP(src="10.0.0.1", dst="10.0.0.2") / ICMP(type=8) / bytes(400)
    frame = bytes(Ether(src="02:00:00:00:00:01", dst=str(MacAddr(mac_of("d")))) / ping)
    for piece in iter_fragments(frame, 0, 96):
        message = encode_message(MailboxHeader(0, type=MailboxType.EOE), piece)
        mailbox.receive_message(message, 0)
    answers = []
    while (message := mailbox.next_message(0)) is not None:
        answers.append(assembler.receive(bytes(decode_message(message)[1])))
    assert len(answers) == 5
    assert answers[:-1] == [None] * 4
    assert Ether(answers[-1])[ICMP].type == 0


def test_idns_of_a_drive():
    spec = SlaveSpec(name="d", kind=DeviceKind.DRIVE, mailbox=MailboxSpec(soe=True))
    mailbox = build_slave(spec).device.mailbox
    mailbox.start(256, 256)
    read_mode = bytes.fromhex("01 40 2000")
    assert ask(mailbox, MailboxType.SOE, read_mode) == (
        MailboxType.SOE,
        bytes.fromhex("02 40 2000 02000000"),
    )
