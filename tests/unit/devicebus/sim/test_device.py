"""What a device shows to the state machine of its slave."""

from __future__ import annotations

import pytest

from devicebus.sim.device import Device
from devicebus.wire.alstatus import AlState
from eap.od.dictionary import ObjectDictionary
from eap.od.model import OdState


@pytest.mark.parametrize(
    ("state", "rights"),
    [(AlState.INIT, OdState.PREOP), (AlState.PREOP, OdState.PREOP), (AlState.BOOT, OdState.PREOP),
     (AlState.SAFEOP, OdState.SAFEOP), (AlState.OP, OdState.OP)],
)  # fmt: skip
def test_state_gives_the_rights_in_the_dictionary(state, rights):
    device = Device("d", ObjectDictionary())
    device.al_state = state
    assert device.od_state() is rights


def test_behaviour_gets_state_and_time():
    seen = []

    class Recorder:
        def step(self, state, now_ns):
            seen.append((state, now_ns))

    device = Device("d", ObjectDictionary(), behaviour=Recorder())
    device.step(7)
    Device("still", ObjectDictionary()).step(8)
    assert seen == [(AlState.INIT, 7)]
