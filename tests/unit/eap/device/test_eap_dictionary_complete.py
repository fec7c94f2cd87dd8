"""Whole objects of an EAP device, and objects before their data is there."""

from __future__ import annotations

import struct

import pytest

from eap.device.stored import configuration
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.profiles.eap1000 import AddressMode, FrameSub, Var
from tests.support.downloads import (
    OP,
    PREOP,
    sender,
    variable,
    write,
)
from tests.unit.eap.device.test_eap_dictionary import two_large_pds


class TestCompleteAccess:
    def test_a_mapping_is_written_whole(self, udp):
        variable(udp, 0x6000, "level")
        data = struct.pack("<H2I", 2, 0x6000_0110, 0x6000_0110)
        udp.download_complete(0x1A05, 0, data, PREOP)
        assert udp.upload_complete(0x1A05, 0, PREOP) == data
        udp.download_complete(0x1A05, 0, struct.pack("<HI", 1, 0x6000_0110), PREOP)
        assert udp[0x1A05].max_subindex == 1

    def test_what_is_refused_in_the_middle_changes_nothing(self, udp):
        sender(udp)
        before = configuration(udp)
        data = struct.pack("<H2I", 2, 0x6000_0110, 0x6001_0110)
        for index in (0x1A00, 0x1A01):
            with pytest.raises(SdoAbortError) as caught:
                udp.download_complete(index, 0, data, PREOP)
            assert caught.value.code == AbortCode.NO_OBJECT
            assert configuration(udp) == before

    def test_zero_deletes_an_object_and_empties_a_mapping(self, udp):
        sender(udp)
        udp.download_complete(0x8000, 0, b"\0\0", PREOP)
        udp.download_complete(0x1A00, 0, b"\0\0", PREOP)
        assert 0x8000 not in udp
        assert udp[0x1A00].max_subindex == 0

    def test_a_frame_comes_back_as_it_was_read(self, udp):
        sender(udp)
        data = udp.upload_complete(0x8000, 0, PREOP)
        write(udp, 0x8000, 0, 0)
        udp.download_complete(0x8000, 0, data, PREOP)
        assert udp.upload_complete(0x8000, 0, PREOP) == data

    @pytest.mark.parametrize(
        ("code", "where", "state"),
        [
            (AbortCode.NO_COMPLETE_ACCESS, (0x1000, 0, b""), PREOP),
            (AbortCode.UNSUPPORTED_ACCESS, (0xD000, 2, b""), PREOP),
            (AbortCode.TOO_SHORT, (0xD000, 0, b"\0"), PREOP),
            (AbortCode.TOO_SHORT, (0xD000, 1, b"\0"), PREOP),
            (AbortCode.TOO_LONG, (0xD000, 1, bytes(2000)), PREOP),
            (AbortCode.TOO_LONG, (0x8000, 0, bytes(20)), PREOP),
            (AbortCode.VALUE, (0x8000, 0, b"\xff\0"), PREOP),
            (AbortCode.READ_ONLY, (0x1018, 1, bytes(16)), PREOP),
            (AbortCode.DEVICE_STATE, (0xF811, 0, b"\0\0"), OP),
            (AbortCode.NO_OBJECT, (0x5000, 0, b"\0\0"), PREOP),
        ],
    )
    def test_refusals(self, udp, code, where, state):
        sender(udp)
        before = configuration(udp)
        with pytest.raises(SdoAbortError) as caught:
            udp.download_complete(*where, state)
        assert caught.value.code == code
        assert configuration(udp) == before

    def test_a_whole_frame_that_is_too_long_is_refused(self, udp):
        two_large_pds(udp)
        write(udp, 0x8000, FrameSub.ADDRESS_MODE, AddressMode.TCP)
        for number in range(2):
            write(udp, 0x8000, FrameSub.TXPD + number, 0xD000 + number)
        data = bytearray(udp.upload_complete(0x8000, 0, PREOP))
        data[3] = AddressMode.IP  # behind sub-index 0 and Enabled
        with pytest.raises(SdoAbortError) as caught:
            udp.download_complete(0x8000, 0, bytes(data), PREOP)
        assert caught.value.code == AbortCode.PDO_LENGTH


class TestBeforeTheDataIsThere:
    def test_a_download_that_may_come_is_let_by(self, udp):
        udp.check_download(0x1A00, 0, 2 + 4 * 254, PREOP, complete=True)
        udp.check_download(0x1A00, 254, 4, PREOP)
        udp.check_download(0x6000, Var.NAME, 255, PREOP)
        udp.check_download(0xF811, 17, 17, PREOP)
        udp.check_download(0xF800, 8, 4, PREOP)
        assert 0x1A00 not in udp

    @pytest.mark.parametrize(
        ("code", "where", "state"),
        [
            (AbortCode.NO_OBJECT, (0x5000, 1, 4), PREOP),
            (AbortCode.DEVICE_STATE, (0x6009, Var.NAME, 4), OP),
            (AbortCode.DEVICE_STATE, (0x6000, Var.NAME, 4), OP),
            (AbortCode.TOO_LONG, (0x6000, Var.NAME, 256), PREOP),
            (AbortCode.NO_SUBINDEX, (0x1A00, 255, 4), PREOP),
            (AbortCode.READ_ONLY, (0x1000, 0, 4), PREOP),
        ],
    )
    def test_a_download_that_cannot_be_is_refused(self, udp, code, where, state):
        variable(udp, 0x6000, "level")
        with pytest.raises(SdoAbortError) as caught:
            udp.check_download(*where, state)
        assert caught.value.code == code

    def test_what_an_object_says_to_be_changeable_is_let_by_in_op(self, udp):
        sender(udp)
        write(udp, 0x8000, FrameSub.CHANGEABLE, 1)
        udp.check_download(0x8000, FrameSub.DESTINATION_MAC, 6, OP)
        with pytest.raises(SdoAbortError) as caught:
            udp.check_download(0x8000, FrameSub.NAME, 6, OP)
        assert caught.value.code == AbortCode.DEVICE_STATE

    def test_the_default_of_a_variable_is_as_long_as_its_type(self, udp):
        variable(udp, 0x6000, "level", "BLOCK(900)")
        udp.check_download(0x6000, Var.DEFAULT, 900, PREOP)
