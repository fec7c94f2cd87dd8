from __future__ import annotations

import msgspec
import pytest

from eap.pd.spec import GatewayAddress, GatewaySpec


def test_a_specification_crosses_as_json():
    told = GatewaySpec(silent=True, addresses=(GatewayAddress(0x9000, members=(1001, 1002)),))
    assert msgspec.json.decode(msgspec.json.encode(told), type=GatewaySpec) == told


def test_fields_that_nobody_knows_are_refused():
    with pytest.raises(msgspec.ValidationError):
        msgspec.json.decode(b'{"quiet": true}', type=GatewaySpec)
