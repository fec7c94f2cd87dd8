from __future__ import annotations

import pytest

from eap.appliance.services.gateway.remote_entries import RemoteEntries, Written
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.model import OdState


def test_what_was_read_is_uploaded():
    entries = RemoteEntries()
    entries.octets = b"\2\0abcd"
    assert entries.upload(0x1018, 1, OdState.OP) == b"\2\0abcd"
    assert entries.upload_complete(0x1018, 0, OdState.OP) == b"\2\0abcd"
    assert entries.upload_complete(0x1018, 1, OdState.OP) == b"abcd"


def test_what_is_downloaded_is_kept():
    entries = RemoteEntries()
    entries.check_download(0x2000, 1, 9, OdState.OP)
    entries.download(0x2000, 1, b"ab", OdState.OP)
    assert entries.written == Written(0x2000, 1, b"ab")
    entries.download_complete(0x2000, 0, b"ab", OdState.OP)
    assert entries.written == Written(0x2000, 0, b"ab", complete=True)
    with pytest.raises(SdoAbortError) as caught:
        entries.check_download(0x2000, 1, 9, OdState.OP, complete=True)
    assert caught.value.code == AbortCode.NO_COMPLETE_ACCESS
