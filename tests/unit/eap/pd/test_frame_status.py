from __future__ import annotations

import pytest

from eap.pd.address import to_word
from eap.pd.frame_status import frame_state, frame_status
from eap.pd.image import Image
from eap.pd.monitor import SubscriberPresence
from eap.pd.spec import TxFrameSpec, TxPdSpec
from eap.pd.words import FrameWord
from tests.support.cyclic import image_of, station, written


@pytest.fixture
def image() -> Image:
    pds = (TxPdSpec("p", 1, ("x",)),)
    frames = (
        TxFrameSpec("f", "eap0", "10.0.0.9", pds, monitor_interval_ms=1000),
        TxFrameSpec("g", "eap0", "239.0.0.9", (TxPdSpec("q", 2, ("x",)),)),
    )
    return image_of(station(variables=written("x:UINT"), frames=frames))


def put(image: Image, **words: int) -> None:
    first = image.layout.frames[0].words
    for name, value in words.items():
        image.words[first + FrameWord[name]] = value


@pytest.mark.parametrize(
    ("state", "presence", "expected"),
    [
        (0, SubscriberPresence.UNKNOWN, 0),
        (0, SubscriberPresence.PRESENT, 0),
        (0, SubscriberPresence.MISSING, 4),
        (1, SubscriberPresence.MISSING, 5),
        (1, SubscriberPresence.UNKNOWN, 1),
    ],
)
def test_bit_2_of_the_state_is_subscriber_missing(
    image: Image, state: int, presence: SubscriberPresence, expected: int
) -> None:
    put(image, UNSENT=state, PRESENCE=presence)
    assert frame_state(image, image.layout.frames[0].words) == expected


def test_status_of_a_frame(image: Image) -> None:
    put(image, WHOLE=5, PARTIAL=2, SKIPPED=1, PRESENCE=1, ADDRESS=to_word("10.0.0.8:4000"))
    assert frame_status(image, image.layout.frames[0]) == {
        "name": "f",
        "port": "eap0",
        "destination": "10.0.0.9",
        "address": "10.0.0.8:4000",
        "sent": 7,
        "skipped": 1,
        "frame_state": 0,
        "monitor_interval_ms": 1000,
        "subscriber": "present",
    }


def test_nobody_is_looked_for_where_nothing_is_monitored(image: Image) -> None:
    row = frame_status(image, image.layout.frames[1])
    assert (row["monitor_interval_ms"], row["subscriber"]) == (None, "unknown")
    assert row["address"] is None
