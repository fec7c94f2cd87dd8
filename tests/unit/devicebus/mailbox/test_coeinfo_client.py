from __future__ import annotations

from contextlib import suppress
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devicebus.errors import BusError, MailboxProtocolError, MailboxRefusedError
from devicebus.mailbox import coeinfo_client
from devicebus.mailbox.coe_server import CoeServer
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.coe import CoeService
from eap.codec.mailbox import MailboxType
from eap.codec.sdoinfo import EntryDescription, ObjectDescription
from eap.od.abort import SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.info import ListType
from eap.od.model import RO, Access, Entry, OdState, record, variable
from tests.support.mailbox import Fault, Line, open_line, run_with, talk_to

COE = MailboxType.COE
PDOS = {CoeService.TX_PDO: b"inputs", CoeService.RX_PDO: b"outputs"}


def serve(size: int = 128, seed: int | None = None) -> Line:
    level = Entry("Level", "INT", RO | Access.TX_MAPPABLE, 5, maximum=9, unit=7)
    dictionary = ObjectDictionary(
        [
            record(0x6000, "Inputs", {1: level}),
            *(variable(0x2000 + n, f"Value {n}", "UINT") for n in range(100)),
        ]
    )
    sizes = MailboxSizes(size, size)
    server = CoeServer(
        dictionary,
        lambda: OdState.PREOP,
        sizes,
        read_pdo=lambda service, number: PDOS[service] if number == 1 else None,
        write_pdo=lambda number, data: (number, data) == (3, b"new"),
    )
    dice = Random(seed)
    bad = [Fault.NONE] * 6 + list(Fault)
    return open_line(COE, server, sizes, lambda: dice.choice(bad) if seed else Fault.NONE)


@pytest.mark.parametrize("size", [16, 40, 256])
@pytest.mark.parametrize("seed", [None, 3])
def test_lists(size: int, seed: int | None) -> None:
    line = serve(size, seed)
    assert line.run(coeinfo_client.object_list()) == [*range(0x2000, 0x2064), 0x6000]
    assert line.run(coeinfo_client.object_list(ListType.TX_MAPPABLE)) == [0x6000]
    assert line.run(coeinfo_client.object_list(ListType.RX_MAPPABLE)) == []
    assert line.run(coeinfo_client.object_list(ListType.COUNTS)) == [101, 0, 1, 0, 0]


@pytest.mark.parametrize("size", [16, 128])
def test_descriptions(size: int) -> None:
    line = serve(size)
    described = line.run(coeinfo_client.object_description(0x6000))
    assert described == ObjectDescription(0x6000, 3, 1, 9, "Inputs")
    entry = line.run(coeinfo_client.entry_description(0x6000, 1))
    assert entry == EntryDescription(0x6000, 1, 3, 16, 0x87, "Level", 7, b"\5\0", None, b"\x09\0")


def test_refusal_is_raised() -> None:
    line = serve()
    with pytest.raises(SdoAbortError, match="0x3000:00: object does not exist"):
        line.run(coeinfo_client.object_description(0x3000))
    with pytest.raises(SdoAbortError, match="0x6000:09: subindex does not exist"):
        line.run(coeinfo_client.entry_description(0x6000, 9))


def test_requests_lie_as_on_the_wire() -> None:
    answer = "0080 02 00 0000 0100 0010"
    listed, asked = run_with(COE, coeinfo_client.object_list(), [answer])
    assert (listed, asked) == ([0x1000], [bytes.fromhex("0080 01 00 0000 0100")])
    answer = "0080 06 00 0000 1810 01 00 0700 2000 0700"
    _, asked = run_with(COE, coeinfo_client.entry_description(0x1018, 1), [answer])
    assert asked == [bytes.fromhex("0080 05 00 0000 1810 01 7f")]


def test_late_and_repeated_fragments_are_not_taken() -> None:
    answers = [
        "0030 43 1810 01 02000000",
        "0080 02 00 0000 0200 99 99",
        "0080 04 00 0000 0100 0700 00 07",
        "0080 82 00 0200 0100 0010",
        "0080 82 00 0200 0100 0010",
        "0080 82 00 0100 0110",
        "0080 82 00 0100 0110",
        "0080 02 00 0000 0210",
    ]
    assert talk_to(COE, coeinfo_client.object_list(), *answers) == [0x1000, 0x1001, 0x1002]


def test_incomplete_bit_alone_does_not_count() -> None:
    answers = ["0080 02 00 0100 0100 0010", "0080 82 00 0000 0110"]
    assert talk_to(COE, coeinfo_client.object_list(), *answers) == [0x1000, 0x1001]


@pytest.mark.parametrize(
    ("answers", "reason"),
    [
        (["0080 02 00 0000 0100 00"], "3 octets, expected whole indexes"),
        (["0080 02"], "needs 4 octets"),
        (["0080 07 00 0000 0100"], "needs 4 octets"),
        (["0080 82 00 0500 0100 0010", "0080 82 00 0300 0110"], "5 fragments left, then 3"),
        (
            [
                f"0080 82 00 {left & 255:02x}{left >> 8:02x} 0100 {'00' * 1000}"
                for left in range(0xFFFF, 0xFF00, -1)
            ],
            "more than 131074 octets",
        ),
    ],
)
def test_answer_that_breaks_the_protocol(answers: list[str], reason: str) -> None:
    with pytest.raises(MailboxProtocolError, match=reason):
        talk_to(COE, coeinfo_client.object_list(), *answers)


def test_description_that_is_cut_breaks_the_protocol() -> None:
    answer = "0080 06 00 0000 1810 01 08 0700 2000 0700"
    with pytest.raises(MailboxProtocolError, match="entry description 0x1018:01"):
        talk_to(COE, coeinfo_client.entry_description(0x1018, 1), answer)


@given(st.lists(st.binary(max_size=16), max_size=10))
def test_any_answers_end_in_a_description_or_a_named_error(noise: list[bytes]) -> None:
    answers = [b"\0\x80" + octets for octets in noise]
    with suppress(BusError, SdoAbortError):
        talk_to(COE, coeinfo_client.object_description(0x1018), *answers)


def test_pdos_go_through_the_mailbox() -> None:
    line = serve()
    assert line.run(coeinfo_client.read_pdo(CoeService.TX_PDO, 1)) == b"inputs"
    assert line.run(coeinfo_client.read_pdo(CoeService.RX_PDO, 1)) == b"outputs"
    line.run(coeinfo_client.write_rx_pdo(3, b"new"))
    assert line.fetch() == []
    with pytest.raises(MailboxRefusedError):
        line.run(coeinfo_client.read_pdo(CoeService.TX_PDO, 2))


def test_other_pdo_is_not_taken() -> None:
    answers = ["0240 ff", "0150 ff", "0140 07"]
    assert talk_to(COE, coeinfo_client.read_pdo(CoeService.TX_PDO, 1), *answers) == b"\7"
