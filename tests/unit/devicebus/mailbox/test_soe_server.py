"""Requests and answers octet for octet; mailboxes have room for 6 octets of data."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devicebus.errors import MailboxRefusedError
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.mailbox.soe_parameter import SoeParameter
from devicebus.mailbox.soe_procedure import Procedure
from devicebus.mailbox.soe_server import FRAGMENT_TIMEOUT_NS, MAX_PENDING, SoeServer
from eap.codec.mailbox import MailboxError
from eap.codec.soe import Display, SoeAttribute
from eap.od.model import OdState

NUMBER = SoeAttribute(length=2, protected_op=1)
LIST = SoeAttribute(length=1, is_list=1, display=Display.IDN)
COMMAND = SoeAttribute(length=1, is_command=1, display=Display.BINARY)


class Drive:
    def __init__(self) -> None:
        self.list = SoeParameter("S-0-0016", "AT list", LIST, max_length=40)
        self.number = SoeParameter("S-0-0032", "Mode", NUMBER, 11)
        reset = SoeParameter("S-0-0099", "Reset", COMMAND, procedure=Procedure(duration_ns=9))
        self.state = OdState.PREOP
        self.server = SoeServer(
            {0: [self.list, self.number, reset], 3: [SoeParameter("P-0-0001", "x", NUMBER, 3)]},
            lambda: self.state,
            MailboxSizes(16, 16),
        )

    def ask(self, octets: str, now_ns: int = 0) -> list[str]:
        answers = self.server.receive_message(bytes.fromhex(octets), now_ns)
        return [answer.hex(" ") for answer in answers]

    def unasked(self, now_ns: int = 0) -> list[str]:
        return [message.hex(" ") for message in self.server.messages_to_send(now_ns)]


def test_value_is_read_and_written() -> None:
    drive = Drive()
    assert drive.ask("01 40 2000") == ["02 40 20 00 0b 00 00 00"]
    assert drive.ask("03 40 2000 0c000000") == ["04 40 20 00"]
    assert drive.ask("01 40 2000") == ["02 40 20 00 0c 00 00 00"]
    assert drive.ask("61 40 0180") == ["62 40 01 80 03 00 00 00"]


@pytest.mark.parametrize(
    ("asked", "answer"),
    [
        ("01 40 2100", "12 40 21 00 01 10"),
        ("21 40 2000", "32 40 20 00 0a 80"),
        ("01 00 2000", "12 00 20 00 0c 80"),
        ("01 01 2000", "12 01 20 00 14 70"),
        ("03 40 2000 0c00", "14 40 20 00 02 70"),
        ("03 02 2000 0c00", "14 02 20 00 04 20"),
    ],
)
def test_refusal(asked: str, answer: str) -> None:
    assert Drive().ask(asked) == [answer]


def test_state_of_the_slave_counts() -> None:
    drive = Drive()
    drive.state = OdState.OP
    assert drive.ask("03 40 2000 0c000000") == ["14 40 20 00 05 70"]


def test_long_answer_goes_in_fragments_that_count_down() -> None:
    drive = Drive()
    drive.list.octets = bytes(range(10))
    assert drive.ask("01 40 1000") == [
        "0a 40 02 00 0a 00 28 00 00 01",
        "0a 40 01 00 02 03 04 05 06 07",
        "02 40 10 00 08 09",
    ]


def test_list_of_all_idns_is_there() -> None:
    drive = Drive()
    assert drive.ask("61 40 1100") == ["6a 40 01 00 04 00 04 00 11 00", "62 40 11 00 01 80"]
    listed = drive.server.drives[0][17].read(0x40, 0)
    assert listed == bytes.fromhex("0800 0800 1000 1100 2000 6300")


def test_fragments_of_a_write_are_joined() -> None:
    drive = Drive()
    assert drive.ask("0b 40 0100 040004000100") == []
    assert drive.ask("03 40 1000 0200") == ["04 40 10 00"]
    assert drive.list.octets == bytes.fromhex("01000200")


def test_fragments_may_be_counted_as_total_by_room() -> None:
    drive = Drive()
    assert drive.ask("0b 40 0200 080008000100") == []
    assert drive.ask("03 40 1000 020003000400") == ["04 40 10 00"]
    assert drive.list.octets == bytes.fromhex("0100020003000400")


@pytest.mark.parametrize(
    ("before", "now_ns"),
    [
        ("0b 40 0300 060006000100", 0),
        ("2b 40 0100 060006000100", 0),
        ("0b 20 0100 060006000100", 0),
        ("0b 40 0100 060006000100", FRAGMENT_TIMEOUT_NS + 1),
    ],
)
def test_fragments_of_another_write_are_forgotten(before: str, now_ns: int) -> None:
    drive = Drive()
    drive.ask(before)
    assert drive.ask("03 40 1000 020002000700", now_ns) == ["04 40 10 00"]
    assert drive.list.octets == b"\7\0"


def test_short_message_does_not_end_a_write_of_which_more_is_missing() -> None:
    drive = Drive()
    assert drive.ask("0b 40 0200 080008000100") == []
    assert drive.ask("03 40 2000 0c000000") == ["04 40 20 00"]


@pytest.mark.parametrize("between", ["01 40 2000", "0b 40 0100 020002000700"])
def test_write_that_starts_again_forgets_what_came_before(between: str) -> None:
    drive = Drive()
    drive.ask("0b 40 0100 040004000100")
    drive.ask(between)
    if between.startswith("01"):
        assert drive.ask("03 40 1000 020002000700") == ["04 40 10 00"]
    else:
        assert drive.ask("03 40 1000") == ["04 40 10 00"]
    assert drive.list.octets == b"\7\0"


def test_reset_forgets_fragments_and_what_waits() -> None:
    drive = Drive()
    drive.ask("03 40 6300 0300")
    drive.server.send_emergency(1)
    drive.ask("0b 40 0100 040004000100")
    drive.server.reset()
    assert drive.unasked(99) == []
    assert drive.ask("01 01 6300", 99) == ["02 01 63 00 03 00"]
    assert drive.ask("03 40 1000 0200") == ["14 40 10 00 02 70"]


def test_endless_fragments_are_not_kept_and_are_too_long() -> None:
    drive = Drive()
    for left in range(30, 0, -1):
        drive.ask(f"0b 40 {left:02x}00 " + "00" * 3000)
    assert drive.ask("03 40 1000 00") == ["14 40 10 00 03 70"]


def test_procedure_command_ends_with_a_notification() -> None:
    drive = Drive()
    assert drive.ask("03 40 6300 0300", 10) == ["04 40 63 00"]
    assert drive.unasked(18) == []
    assert drive.ask("01 01 6300", 18) == ["02 01 63 00 07 00"]
    assert drive.unasked(19) == ["05 01 63 00 03 00"]
    assert drive.unasked(20) == []
    assert drive.ask("03 40 6300 0000", 21) == ["04 40 63 00"]
    assert drive.unasked(99) == []


def test_emergency_lies_as_on_the_wire() -> None:
    drive = Drive()
    drive.server.send_emergency(0x2310, 3, b"\7", drive=1)
    assert drive.unasked() == ["26 00 00 00 10 23 03 07 00 00 00 00"]


def test_messages_that_nobody_fetches_are_dropped_and_counted() -> None:
    drive = Drive()
    for code in range(MAX_PENDING + 2):
        drive.server.send_emergency(code)
    assert drive.server.dropped == 2
    assert len(drive.unasked()) == MAX_PENDING


@pytest.mark.parametrize(
    ("octets", "detail"),
    [
        ("01 40 20", MailboxError.SIZE_TOO_SHORT),
        ("02 40 2000", MailboxError.SERVICE_NOT_SUPPORTED),
        ("05 40 2000", MailboxError.SERVICE_NOT_SUPPORTED),
        ("00 40 2000", MailboxError.SERVICE_NOT_SUPPORTED),
    ],
)
def test_what_is_no_request_gets_a_mailbox_error(octets: str, detail: MailboxError) -> None:
    with pytest.raises(MailboxRefusedError) as caught:
        Drive().ask(octets)
    assert caught.value.detail == detail


def test_drive_number_has_three_bits() -> None:
    with pytest.raises(ValueError, match=r"drives \[8\], expected numbers from 0 to 7"):
        SoeServer({8: []}, lambda: OdState.OP, MailboxSizes())


@given(st.lists(st.tuples(st.binary(max_size=12), st.integers(0, 1 << 33)), max_size=20))
def test_any_requests_are_answered_or_refused(requests: list[tuple[bytes, int]]) -> None:
    drive = Drive()
    for request, now_ns in requests:
        try:
            answers = drive.server.receive_message(request, now_ns)
        except MailboxRefusedError:
            continue
        assert all(len(answer) <= 10 for answer in answers)
