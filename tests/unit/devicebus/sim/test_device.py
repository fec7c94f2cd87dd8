"""Interface of a device to the state machine of its slave."""

from __future__ import annotations

import pytest

from devicebus.sim.device import Device, FaultyDictionary
from devicebus.wire.alstatus import AlState
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import RO, RW, Entry, OdState, record, variable

CALLS = [
    lambda d: d.upload(0x8000, 1, OdState.OP),
    lambda d: d.download(0x8000, 1, b"\x05", OdState.OP),
    lambda d: d.upload_complete(0x8000, 1, OdState.OP),
    lambda d: d.download_complete(0x8000, 1, b"\x05", OdState.OP),
]


@pytest.mark.parametrize("call", CALLS)
def test_sdo_fault_refuses_every_access_until_its_end(call):
    dictionary = FaultyDictionary([record(0x8000, "r", {1: Entry("e", "USINT", RW)})])
    dictionary.aborts[0x8000] = AbortCode.HARDWARE
    with pytest.raises(SdoAbortError) as caught:
        call(dictionary)
    assert caught.value.code == AbortCode.HARDWARE
    assert dictionary.entry(0x8000, 1).value == 0
    dictionary.aborts.clear()
    call(dictionary)


@pytest.mark.parametrize(
    ("state", "rights"),
    [(AlState.INIT, OdState.PREOP), (AlState.PREOP, OdState.PREOP), (AlState.BOOT, OdState.PREOP),
     (AlState.SAFEOP, OdState.SAFEOP), (AlState.OP, OdState.OP)],
)  # fmt: skip
def test_state_gives_the_rights_in_the_dictionary(state, rights):
    device = Device("d", ObjectDictionary())
    device.al_state = state
    assert device.od_state() is rights


def test_device_behaviour_receives_state_and_time():
    seen = []

    class Recorder:
        def step(self, state, now_ns):
            seen.append((state, now_ns))

    device = Device("d", ObjectDictionary(), behaviour=Recorder())
    device.step(7)
    Device("still", ObjectDictionary()).step(8)
    assert seen == [(AlState.INIT, 7)]


class Counter:
    """Counts up what it finds in an entry."""

    def __init__(self, dictionary):
        self.seen = []
        self._entry = dictionary.entry(0x6000, 0)

    def step(self, state, now_ns):
        self.seen.append(self._entry.value)
        self._entry.value += 1


def test_device_override_stays_until_release():
    dictionary = ObjectDictionary([variable(0x6000, "count", "UINT", RO, 5)])
    counter = Counter(dictionary)
    device = Device("d", dictionary, behaviour=counter)
    device.step(0)
    for value in (100, 200):
        device.override(0x6000, 0, value)
        assert dictionary.entry(0x6000, 0).value == value
        device.step(1)
        assert (counter.seen[-1], dictionary.entry(0x6000, 0).value) == (value, value)
    assert device.release(0x6000, 0)
    assert dictionary.entry(0x6000, 0).value == 6
    device.step(2)
    assert dictionary.entry(0x6000, 0).value == 7
    assert not device.release(0x6000, 0)


def test_device_override_refuses_an_invalid_value():
    device = Device("d", ObjectDictionary([variable(0x6000, "count", "UINT", RO, 5)]))
    with pytest.raises(ValueError, match="70000 is not a value of UINT"):
        device.override(0x6000, 0, 70000)
    assert not device.release(0x6000, 0)
    with pytest.raises(SdoAbortError):
        device.override(0x6001, 0, 1)


def test_device_without_mailbox_sets_its_error_register():
    device = Device("d", ObjectDictionary([variable(0x1001, "Error", "USINT", RO)]))
    device.report_error(0x1000)
    assert device.dictionary.entry(0x1001, 0).value == 1
    Device("bare", ObjectDictionary()).report_error(0x1000)
