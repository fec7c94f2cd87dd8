from __future__ import annotations

import pytest

from eap.codec.ethercat import EtherCatHeader
from eap.codec.pd import FIRST_PD
from eap.pd.frame_plan import walk
from eap.pd.words import Discard
from tests.support.cyclic import octets

FRAME = octets([(7, b"\x01\x02"), (8, b""), (9, b"\x03", 4)])


def walked(data: bytes, size: int | None = None):
    return walk(memoryview(data), len(data) if size is None else size)


def test_each_pd_with_its_place():
    found = walked(FRAME + b"padding", len(FRAME))
    assert [(pd.pd_id, pd.version, pd.length, at) for pd, at in found] == [
        (7, 0, 2, FIRST_PD),
        (8, 0, 0, FIRST_PD + 10),
        (9, 4, 1, FIRST_PD + 18),
    ]


@pytest.mark.parametrize("size", range(len(FRAME)))
def test_every_frame_that_is_cut_off_is_dropped(size):
    assert walked(FRAME, size) is Discard.TRUNCATED


def test_what_is_no_process_data_is_told_apart():
    assert walked(EtherCatHeader(0, 0, 1).encode() + bytes(20)) is Discard.WRONG_TYPE


def test_more_pds_than_fit_are_not_looked_for():
    many = bytearray(FRAME)
    many[8:10] = b"\xff\xff"
    assert walked(bytes(many)) is Discard.COUNT_TOO_LARGE
