from __future__ import annotations

from eap.ads.endpoint import Endpoint


def test_way_is_named_by_both_parts() -> None:
    assert str(Endpoint("AMS/TCP", "10.0.0.1:3456 #7")) == "10.0.0.1:3456 #7 by AMS/TCP"
    assert str(Endpoint("ams-tcp:10.0.0.1:48898", "10.0.0.1:48898")) == "10.0.0.1:48898 by ams-tcp"
