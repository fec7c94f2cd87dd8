"""A dictionary that refuses what it was told to."""

from __future__ import annotations

import pytest

from devicebus.sim.faultydictionary import FaultyDictionary
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.model import RW, Entry, OdState, record

CALLS = [
    lambda d: d.upload(0x8000, 1, OdState.OP),
    lambda d: d.download(0x8000, 1, b"\x05", OdState.OP),
    lambda d: d.upload_complete(0x8000, 1, OdState.OP),
    lambda d: d.download_complete(0x8000, 1, b"\x05", OdState.OP),
]


@pytest.mark.parametrize("call", CALLS)
def test_every_access_is_refused_until_it_is_over(call):
    dictionary = FaultyDictionary([record(0x8000, "r", {1: Entry("e", "USINT", RW)})])
    dictionary.aborts[0x8000] = AbortCode.HARDWARE
    with pytest.raises(SdoAbortError) as caught:
        call(dictionary)
    assert caught.value.code == AbortCode.HARDWARE
    assert dictionary.entry(0x8000, 1).value == 0
    dictionary.aborts.clear()
    call(dictionary)
