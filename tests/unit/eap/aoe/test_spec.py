from __future__ import annotations

import msgspec
import pytest

from eap.aoe.spec import AccessRule, AccessService, AccessTarget, ObjectRange


def test_rules_survive_the_way_to_another_process():
    rule = AccessRule(
        "engineering",
        networks=("10.0.0.0/24",),
        targets=(AccessTarget("127.0.1.3.3.1", 1001),),
        services=(AccessService.WRITE,),
        objects=(ObjectRange(0x8000, 0x8FFF),),
    )
    assert msgspec.json.decode(msgspec.json.encode(rule), type=AccessRule) == rule


def test_what_no_rule_has_is_refused():
    with pytest.raises(msgspec.ValidationError):
        msgspec.json.decode(b'{"name": "x", "alow": true}', type=AccessRule)
