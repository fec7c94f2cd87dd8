from __future__ import annotations

from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devicebus.errors import BusError, MailboxProtocolError, SoeError
from devicebus.mailbox import soe_browse
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.mailbox.soe_browse import IdnDescription
from devicebus.mailbox.soe_parameter import SoeParameter
from devicebus.mailbox.soe_server import SoeServer
from eap.codec.mailbox import MailboxType
from eap.codec.soe import Display, Idn, SoeAttribute
from eap.od.model import OdState
from tests.support.mailbox import Line, open_line, talk_to

SOE = MailboxType.SOE
SPEED = SoeAttribute(length=2, display=Display.SIGNED, decimals=1)
AXES = SoeAttribute(length=1, is_list=1, display=Display.UNSIGNED)


def serve() -> Line:
    sizes = MailboxSizes(20, 20)
    parameters = [
        SoeParameter("S-0-0036", "Velocity", SPEED, -5, unit="rpm", limits=(-100, 200)),
        SoeParameter("P-0-0001", "", AXES, [1, 2, 3]),
    ]
    return open_line(SOE, SoeServer({2: parameters}, lambda: OdState.OP, sizes), sizes)


def test_list_of_all_idns() -> None:
    listed = serve().run(soe_browse.idn_list(drive=2))
    assert [str(idn) for idn in listed] == ["S-0-0017", "S-0-0036", "P-0-0001"]


def test_idn_with_every_element() -> None:
    idn = Idn.parse("S-0-0036")
    described = serve().run(soe_browse.describe(idn, drive=2))
    assert described == IdnDescription(idn, SPEED, -5, "Velocity", "rpm", -100, 200, -5)


def test_idn_with_few_elements() -> None:
    idn = Idn.parse("P-0-0001")
    described = serve().run(soe_browse.describe(idn, drive=2))
    assert described == IdnDescription(idn, AXES, [1, 2, 3], default=[1, 2, 3])


def test_idn_that_is_not_there() -> None:
    with pytest.raises(SoeError, match="S-0-0099 at drive 2: no such IDN"):
        serve().run(soe_browse.describe(Idn.parse("S-0-0099"), drive=2))


@pytest.mark.parametrize(
    ("answers", "reason"),
    [
        (["02 04 2400 0100"], "attribute of S-0-0036"),
        (["02 04 2400 01002200", "02 40 2400 01", *["12 40 2400 0120"] * 6], "elements of"),
        (["02 04 2400 01002200", "02 40 2400 00000000", "02 02 2400 05000500"], "elements of"),
    ],
)
def test_answer_that_breaks_the_protocol(answers: list[str], reason: str) -> None:
    refusals = ["12 00 2400 0120"] * 6
    with pytest.raises(MailboxProtocolError, match=reason):
        talk_to(SOE, soe_browse.describe(Idn.parse("S-0-0036")), *answers, *refusals)


def test_list_that_is_no_list_breaks_the_protocol() -> None:
    for answer in ("02 40 1100 0300 0300 010002", "02 40 1100 0400 0400 0100"):
        with pytest.raises(MailboxProtocolError, match="IDN list S-0-0017"):
            talk_to(SOE, soe_browse.idn_list(), answer)


@given(st.lists(st.binary(max_size=12), max_size=10))
def test_any_answers_end_in_a_description_or_a_named_error(noise: list[bytes]) -> None:
    answers = [b"\2\4\x24\0" + octets for octets in noise]
    with suppress(BusError):
        talk_to(SOE, soe_browse.describe(Idn.parse("S-0-0036")), *answers)
