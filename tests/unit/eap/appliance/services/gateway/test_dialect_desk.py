"""Who may have tasks of the dialect done; the rest is in test_gateway."""

from __future__ import annotations

import pytest

from eap.aoe.access import service_of
from eap.aoe.spec import AccessService
from eap.appliance.services.gateway.dialect_desk import operation_of
from eap.codec.soe import Element
from eap.gateway.dialect import ReadFile, ReadIdn, ReadSdo, TalkVoe, WriteIdn, WriteSdo


@pytest.mark.parametrize(
    ("task", "service"),
    [
        (ReadSdo(0x1018, 1, complete=True), AccessService.READ),
        (WriteSdo(0x1018, 1, b"1"), AccessService.WRITE),
        (ReadIdn(32, 1, Element.VALUE), AccessService.READ),
        (WriteIdn(32, 1, Element.VALUE, b"1"), AccessService.WRITE),
        (ReadFile("f"), AccessService.READ),
        (TalkVoe(b""), AccessService.RAW),
    ],
)
def test_what_a_task_does(task, service) -> None:
    assert service_of(operation_of(task)) is service
