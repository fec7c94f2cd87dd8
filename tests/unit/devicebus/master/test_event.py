from __future__ import annotations

from typing import get_args

import pytest

from devicebus.master import event

KINDS = [each for each in get_args(event.Event) if each.__module__ == event.__name__]


@pytest.mark.parametrize("kind", KINDS)
def test_every_event_tells_when_and_cannot_be_changed(kind):
    made = kind(*range(len(kind.__struct_fields__)))
    assert kind.__struct_fields__[-1] == "at_ns"
    with pytest.raises(AttributeError):
        made.at_ns = 5
