from __future__ import annotations

from eap.device.fault import FAULT_TEXTS, DeviceFault, FaultCode


def test_every_code_has_a_text_of_its_own():
    assert set(FAULT_TEXTS) == set(FaultCode)
    assert len(set(FAULT_TEXTS.values())) == len(FaultCode)


def test_codes_leave_room_for_those_of_the_standard():
    assert all(code < 0x20 or code >= 0x8000 for code in FaultCode)


def test_a_fault_says_where_what_and_why():
    fault = DeviceFault(FaultCode.CYCLE_TIME, "1500 us", 0xD001, 7, "eap0")
    assert fault.text == str(fault)
    assert fault.text == "0xD001:07: cycle time does not fit the device cycle: 1500 us"
    assert (fault.code, fault.index, fault.subindex, fault.port) == (0x800D, 0xD001, 7, "eap0")
    assert DeviceFault(FaultCode.NO_MAILBOX).text == "mailbox is not set up"
