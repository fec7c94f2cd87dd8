from __future__ import annotations

import pytest

from eap.pd.spec import RxPdSpec, Substitute, VariableSpec, Writer
from eap.pd.subscription import SubstituteValue
from tests.support.cyclic import Receiver, octets

DATA = bytes([0b1011, 0xAA, 0xBB])


@pytest.mark.parametrize(
    ("substitute", "values"),
    [
        (Substitute.HOLD, {"on": True, "mode": 5, "speed": 0xBBAA}),
        (Substitute.ZERO, {"on": False, "mode": 0, "speed": 0}),
        (Substitute.DEFAULT, {"on": False, "mode": 6, "speed": 1500}),
    ],
)
def test_substitute_replaces_the_data_and_nothing_else(substitute, values):
    variables = (
        VariableSpec("on", "BOOL", Writer.ENGINE),
        VariableSpec("mode", "BIT3", Writer.ENGINE, default=6),
        VariableSpec("speed", "UINT", Writer.ENGINE, default=1500),
        VariableSpec("next", "UINT", Writer.ENGINE, default=9),
    )
    r = Receiver(
        RxPdSpec("r", "eap0", 1, ("on", "mode", "speed"), substitute=substitute),
        RxPdSpec("s", "eap0", 2, ("next",)),
        variables=variables,
    )
    r.give(octets([(1, DATA, 0, 77)]), 0)
    place = r.place("r")
    header = bytes(r.image.memory[place.offset : place.offset + 8])
    SubstituteValue(r.image, place).apply()
    assert r.image.read_all() | values == r.image.read_all()
    assert r.image.read("next") == 9
    assert bytes(r.image.memory[place.offset : place.offset + 8]) == header
