from __future__ import annotations

from eap.device.live import NothingRuns
from eap.od.profiles.eap1000keys import Live


def test_nothing_is_shown_of_what_does_not_run():
    assert {NothingRuns().octets(key, "any") for key in Live} == {None}
