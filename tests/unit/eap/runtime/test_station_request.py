from __future__ import annotations

import msgspec

from eap.runtime.station_request import Configure, SetState, StationRequest


def test_requests_are_told_apart_by_what_to_do():
    octets = msgspec.msgpack.encode(Configure(id=1, station="a", path="/x"))
    assert msgspec.msgpack.decode(octets) == {
        "do": "configure",
        "id": 1,
        "station": "a",
        "path": "/x",
    }
    octets = msgspec.msgpack.encode(SetState(id=2, station="a", state=4))
    decoded = msgspec.msgpack.decode(octets, type=StationRequest)
    assert decoded == SetState(id=2, station="a", state=4)
