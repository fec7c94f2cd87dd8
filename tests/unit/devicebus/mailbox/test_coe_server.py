from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devicebus.errors import MailboxRefusedError
from devicebus.mailbox.coe_server import MAX_PENDING, CoeServer
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.coe import CoeService
from eap.codec.mailbox import MailboxError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import RO, OdState, variable

DICTIONARY = ObjectDictionary([variable(0x1000, "Device type", "UDINT", RO, 0x1389)])


def make() -> tuple[CoeServer, dict[int, bytes]]:
    written: dict[int, bytes] = {}

    def read(service: CoeService, number: int) -> bytes | None:
        return {(CoeService.TX_PDO, 1): b"tx", (CoeService.RX_PDO, 2): b"rx"}.get((service, number))

    def write(number: int, data: bytes) -> bool:
        written[number] = data
        return number == 2

    sizes = MailboxSizes()
    server = CoeServer(DICTIONARY, lambda: OdState.PREOP, sizes, read_pdo=read, write_pdo=write)
    return server, written


def ask(server: CoeServer, octets: str) -> list[str]:
    return [answer.hex(" ") for answer in server.receive_message(bytes.fromhex(octets), 0)]


def refusal(server: CoeServer, octets: str) -> str:
    with pytest.raises(MailboxRefusedError) as caught:
        ask(server, octets)
    return MailboxError(caught.value.detail).name


def test_sdo_and_sdo_information_are_answered() -> None:
    server, _ = make()
    assert ask(server, "0020 40 0010 00 00000000") == ["00 30 43 00 10 00 89 13 00 00"]
    assert ask(server, "0080 01 00 0000 0100") == ["00 80 02 00 00 00 01 00 00 10"]


def test_remote_requests_are_answered_with_the_pdo() -> None:
    server, _ = make()
    assert ask(server, "0160") == ["01 40 74 78"]
    assert ask(server, "0270") == ["02 50 72 78"]


def test_rx_pdo_is_taken_without_an_answer() -> None:
    server, written = make()
    assert ask(server, "0250 0102") == []
    assert written == {2: b"\1\2"}


@pytest.mark.parametrize("octets", ["0260", "0170", "0350 0102", "0140", "0030", "0010", "0090"])
def test_what_is_no_service_of_a_slave_gets_a_mailbox_error(octets: str) -> None:
    assert refusal(make()[0], octets) == "SERVICE_NOT_SUPPORTED"


def test_slave_without_pdos_refuses_them() -> None:
    server = CoeServer(DICTIONARY, lambda: OdState.PREOP, MailboxSizes())
    assert refusal(server, "0160") == "SERVICE_NOT_SUPPORTED"
    assert refusal(server, "0250 0102") == "SERVICE_NOT_SUPPORTED"


def test_message_without_a_header_is_too_short() -> None:
    assert refusal(make()[0], "00") == "SIZE_TOO_SHORT"


def test_emergency_and_pdo_are_sent_once() -> None:
    server, _ = make()
    server.send_emergency(0x2310, 3, b"\7")
    server.send_tx_pdo(1, b"tx")
    assert [data.hex(" ") for data in server.messages_to_send(0)] == [
        "00 10 10 23 03 07 00 00 00 00",
        "01 40 74 78",
    ]
    assert server.messages_to_send(0) == []


def test_emergencies_that_nobody_fetches_are_dropped_and_counted() -> None:
    server, _ = make()
    for code in range(MAX_PENDING + 2):
        server.send_emergency(code)
    assert server.dropped == 2
    assert [data[2] for data in server.messages_to_send(0)] == list(range(MAX_PENDING))


def test_reset_forgets_what_waits() -> None:
    server, _ = make()
    server.send_emergency(1)
    server.reset()
    assert server.messages_to_send(0) == []


@given(st.binary(max_size=24))
def test_any_octets_are_answered_or_refused(noise: bytes) -> None:
    try:
        answers = make()[0].receive_message(noise, 0)
    except MailboxRefusedError:
        return
    assert all(len(answer) <= 122 for answer in answers)
