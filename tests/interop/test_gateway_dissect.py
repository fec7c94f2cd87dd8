"""tshark reads in the gateway's replies what we mean, in each protocol and for each error."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from eap.codec import coe, foe, soe
from eap.codec.coe import CoeHeader, CoeService
from eap.codec.mailbox import MailboxType, decode_frame
from tests.support.gatewayplant import COUPLER, DRIVE, MUTE, SENSOR, gateway_plant
from tests.support.gatewaywire import AOE, COE, EOE, FOE, SOE, VOE, frame, wire
from tests.support.packets import udp
from tests.support.tshark import dissect, write_pcap
from tests.support.vectors import load

pytestmark = [pytest.mark.net, pytest.mark.tshark]

HOST = "127.9.86.2"
FILE, NO_FILE = b"firmware.bin".hex(), b"missing".hex()
REQUESTS = (
    (COE, DRIVE, "0020 40 1810 01 00000000"),
    (COE, DRIVE, "0020 50 1810 00 00000000"),
    (COE, DRIVE, "0020 40 0810 00 00000000"),
    (COE, DRIVE, "0020 40 5555 00 00000000"),
    (COE, DRIVE, "0020 2b 4060 00 00000000"),
    (COE, DRIVE, "0080 01 00 0000 0100"),
    (COE, DRIVE, "0080 05 00 0000 1810 01 07"),
    (COE, SENSOR, "0020 40 0180 00 00000000"),
    (COE, SENSOR, "0020 60 00000000 000000"),
    (COE, SENSOR, "0020 70 00000000 000000"),
    (COE, MUTE, "0020 40 1810 01 00000000"),
    (COE, COUPLER, "0020 40 1810 01 00000000"),
    (COE, 1777, "0080 03 00 0000 1810"),
    (COE, 0, "0020 40 1810 01 00000000"),
    (COE, 0, "0020 50 0080 00 00000000"),
    (COE, 0, "0020 40 0810 00 00000000"),
    (COE, 0, "0020 40 5555 00 00000000"),
    (COE, 0, "0080 01 00 0000 0100"),
    (COE, 0, "0080 03 00 0000 1810"),
    (COE, 0, "0080 05 00 0000 1810 01 7f"),
    *((SOE, DRIVE, f"01 {1 << bit:02x} 2400") for bit in range(7)),
    (SOE, DRIVE, "03 40 2000 02000000"),
    (SOE, DRIVE, "01 40 0110"),
    (SOE, DRIVE, "41 40 2000"),
    (SOE, 1777, "01 40 2000"),
    (FOE, DRIVE, "01 00 00000000" + FILE),
    (FOE, DRIVE, "01 00 00000000" + NO_FILE),
    (FOE, DRIVE, "02 00 00000000" + b"parameters.bin".hex()),
    (FOE, DRIVE, "03 00 01000000 6162"),
    (FOE, 1777, "01 00 00000000" + FILE),
    (FOE, SENSOR, "01 00 00000000" + FILE),
    (VOE, DRIVE, "64110000 0100 0102"),
    (EOE, DRIVE, "06000000"),
    (AOE, DRIVE, "00"),
    (6, DRIVE, "00"),
)


class Reply(NamedTuple):
    """A reply, as it was and as tshark sees it."""

    octets: bytes
    seen: dict[str, Any]

    @property
    def kind(self) -> int:
        return self.octets[7] & 0x0F

    @property
    def body(self) -> bytes:
        return self.octets[8:]

    def field(self, name: str) -> int:
        return int(self.fields[f"ecat_mailbox.{name}"], 0)

    @property
    def fields(self) -> dict[str, str]:
        return dict(_flat(self.seen["layers"]["ecat_mailbox"]))


def _flat(layer: dict[str, Any]) -> Iterator[tuple[str, str]]:
    for name, value in layer.items():
        if isinstance(value, dict):
            yield from _flat(value)
        elif isinstance(value, str):
            yield name, value


@pytest.fixture(scope="module")
def replies(tmp_path_factory: pytest.TempPathFactory) -> list[Reply]:
    requests = [frame(kind, to, bytes.fromhex(body)) for kind, to, body in REQUESTS]
    requests += [each.octets for each in load("type5_gateway") if each.layer == "frame"]
    with gateway_plant(HOST), wire(HOST) as client:
        # One is cut off, to which there is no answer.
        whole = [each for each in requests if not each.startswith(b"\x00\x51")]
        found = [client.ask(each) for each in whole]
    path = write_pcap(Path(tmp_path_factory.mktemp("seen"), "replies.pcap"), map(udp, found))
    return [Reply(*pair) for pair in zip(found, dissect(path), strict=True)]


def test_nothing_is_malformed_and_each_header_is_ours(replies: list[Reply]) -> None:
    for reply in replies:
        assert not reply.seen["malformed"], reply.octets.hex()
        header, body = decode_frame(reply.octets)
        assert reply.seen["mailbox"] == {
            "length": len(body),
            "address": header.address,
            "type": int(header.type),
            "counter": header.counter,
        }
    assert {reply.kind for reply in replies} == {0, COE, EOE, FOE, SOE, VOE}


def test_wireshark_reads_coe_replies(replies: list[Reply]) -> None:
    seen = {"service": 0, "expedited": 0, "normal": 0, "abort": 0, "info": 0}
    for reply in (each for each in replies if each.kind == MailboxType.COE):
        header = CoeHeader.decode(reply.body)
        assert (reply.field("coe.number"), reply.field("coe.type")) == (0, header.service)
        seen["service"] += 1
        if header.service == CoeService.SDO_INFORMATION:
            _check_info(reply)
            seen["info"] += 1
            continue
        command = reply.body[2]
        specifier = "sdoreq" if header.service == CoeService.SDO_REQUEST else "sdores"
        assert reply.field(f"coe.{specifier}") == command >> 5
        if header.service == CoeService.SDO_REQUEST:
            code = int.from_bytes(reply.body[6:10], "little")
            assert reply.field("coe.abortcode") == code
            seen["abort"] += 1
        elif command >> 5 == coe.SdoResponse.UPLOAD:
            head = coe.SdoHeader.decode(reply.body, CoeHeader.SIZE)
            place = reply.field("coe.sdoidx"), reply.field("coe.sdosub")
            assert place == (head.index, head.subindex)
            assert reply.field("coe.sdoscsiu_expedited") == head.expedited
            name = "coe.sdodata" if head.expedited else "coe.sdolength"
            assert reply.field(name) == int.from_bytes(reply.body[6:10], "little")
            seen["expedited" if head.expedited else "normal"] += 1
    assert all(seen.values()), seen


def _check_info(reply: Reply) -> None:
    opcode = reply.body[2] & 0x7F
    assert reply.field("coe.sdoinfoopcode") == opcode
    if opcode == coe.SdoInfoOpcode.OBJECT_RESPONSE:
        told = coe.ObjectDescription.decode(reply.body[6:])
        assert reply.field("coe.sdoinfoindex") == told.index
        assert reply.field("coe.sdoinfodatatype") == told.data_type
        assert reply.field("coe.sdoinfomaxsub") == told.max_subindex
        assert reply.field("coe.sdoinfoobjcode") == told.code
    elif opcode == coe.SdoInfoOpcode.ENTRY_RESPONSE:
        index, subindex, info = reply.body[6] | reply.body[7] << 8, reply.body[8], reply.body[9]
        assert reply.field("coe.sdoinfoindex") == index
        assert reply.field("coe.sdoinfosubindex") == subindex
        assert reply.field("coe.sdoinfovalueinfo") == info


def test_wireshark_reads_soe_replies(replies: list[Reply]) -> None:
    found = [each for each in replies if each.kind == MailboxType.SOE]
    for reply in found:
        head = soe.SoeHeader.decode(reply.body)
        assert reply.field("soe_header") == int.from_bytes(reply.body[:2], "little")
        assert reply.field("soe_opcode") == head.opcode
        assert reply.field("soe_header_error") == head.error
        assert reply.field("soe_header_driveno") == head.drive
        assert reply.field("soe_idn") == int.from_bytes(reply.body[2:4], "little")
        if not head.error and len(reply.body) > 4:
            assert reply.fields["ecat_mailbox.soe_data"] == reply.body[4:].hex(":")
    assert {reply.field("soe_header_error") for reply in found} == {0, 1}
    assert {reply.body[1] for reply in found} >= {1 << bit for bit in range(7)}


def test_wireshark_reads_foe_replies(replies: list[Reply]) -> None:
    found = [each for each in replies if each.kind == MailboxType.FOE]
    for reply in found:
        header, body = foe.decode_message(reply.body)
        assert reply.field("foe_opmode") == header.opcode
        if header.opcode == foe.FoeOpcode.ERROR:
            assert reply.field("foe_errcode") == header.number
            assert reply.fields["ecat_mailbox.foe_errtext"] == foe.text_of(bytes(body))
        else:
            assert reply.field("foe_packetno") == header.number
    opcodes = {reply.field("foe_opmode") for reply in found}
    assert opcodes == {foe.FoeOpcode.DATA, foe.FoeOpcode.ACK, foe.FoeOpcode.ERROR}
