from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devicebus.mailbox.protocol import MailboxSizes
from devicebus.mailbox.sdoinfo_server import SdoInfoServer
from eap.codec.coe import CoeService, decode_message
from eap.codec.sdoinfo import SdoInfoHeader, SdoInfoOpcode
from eap.od.dictionary import ObjectDictionary
from eap.od.model import RO, Access, Entry, record, variable

DICTIONARY = ObjectDictionary(
    [
        variable(0x1000, "Device type", "UDINT", RO, 0x1389),
        record(0x6000, "Inputs", {1: Entry("Level", "INT", RO | Access.TX_MAPPABLE, maximum=9)}),
        *(variable(0x2000 + n, f"Value {n}", "UINT") for n in range(40)),
    ]
)


def ask(octets: str, size: int = 128) -> list[str]:
    """Return the answers behind their CoE headers."""
    server = SdoInfoServer(DICTIONARY, MailboxSizes(128, size))
    answers = []
    for answer in server.receive_request(bytes.fromhex(octets)):
        header, body = decode_message(answer)
        assert header.service is CoeService.SDO_INFORMATION
        assert len(answer) <= size - 6
        answers.append(body.hex(" "))
    return answers


def test_list() -> None:
    assert ask("01 00 0000 0300") == ["02 00 00 00 03 00 00 60"]
    assert ask("01 00 0000 0000") == ["02 00 00 00 00 00 2a 00 00 00 01 00 00 00 00 00"]


def test_list_in_fragments_that_count_down() -> None:
    answers = [bytes.fromhex(answer) for answer in ask("01 00 0000 0100", 43)]
    headers = [SdoInfoHeader.decode(answer) for answer in answers]
    assert {header.opcode for header in headers} == {SdoInfoOpcode.LIST_RESPONSE}
    assert [(header.incomplete, header.fragments_left) for header in headers] == [
        (1, 2), (1, 1), (0, 0)
    ]  # fmt: skip
    assert [len(answer) - 4 for answer in answers] == [30, 30, 26]
    listed = b"".join(answer[4:] for answer in answers)
    indexes = [0x1000, *range(0x2000, 0x2028), 0x6000]
    assert listed == b"".join(number.to_bytes(2, "little") for number in [1, *indexes])


def test_object_description() -> None:
    assert ask("03 00 0000 0010") == ["04 00 00 00 00 10 07 00 00 07 " + b"Device type".hex(" ")]


def test_entry_description() -> None:
    assert ask("05 00 0000 0060 01 7f") == [
        "06 00 00 00 00 60 01 57 03 00 10 00 87 00 00 00 09 00 " + b"Level".hex(" ")
    ]


@pytest.mark.parametrize(
    ("asked", "code"),
    [
        ("03 00 0000 0030", "00 00 02 06"),
        ("05 00 0000 0060 07 00", "11 00 09 06"),
        ("01 00 0000 0600", "43 00 04 06"),
        ("03 00 0000 00", "13 00 07 06"),
        ("05 00", "13 00 07 06"),
        ("02 00 0000 0100", "01 00 04 05"),
        ("7f 00 0000 0100", "01 00 04 05"),
    ],
)
def test_refusal(asked: str, code: str) -> None:
    assert ask(asked) == [f"07 00 00 00 {code}"]


@given(st.binary(max_size=12))
def test_any_request_gets_an_answer(noise: bytes) -> None:
    assert ask(noise.hex(), 16)
