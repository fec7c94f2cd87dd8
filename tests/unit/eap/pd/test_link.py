from __future__ import annotations

from eap.pd.link import OutFrame


def test_a_frame_is_patched_in_place_and_seen_through_its_view():
    buffer = bytearray(b"headerframe")
    frame = OutFrame(buffer, 6, "01:01:05:04:00:00")
    buffer[6:] = b"FRAME"
    assert bytes(frame.view[frame.headroom :]) == b"FRAME"
    assert frame.destination == "01:01:05:04:00:00"


def test_a_frame_is_of_a_good_size_until_a_channel_finds_otherwise():
    assert not OutFrame(bytearray(9), 0, "10.0.0.1").oversized
