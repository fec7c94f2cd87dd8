"""Access decisions, and their audit."""

from __future__ import annotations

import pytest

from eap.ads.request import Read, Write
from eap.ams.access import AccessList, AuditEntry
from eap.ams.spec import AccessRule, AccessService
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.mailbox import MailboxType
from eap.gateway.error_table import Cause
from eap.gateway.requests import error_reply
from eap.ids import Endpoint, NetId
from eap.services.gateway.admission import GatewayAdmission, RuleTarget, denial_cause, result_of
from eap.services.gateway.sessions import GatewayReply

TARGET = RuleTarget(NetId.parse("5.1.1.1.3.1"), 1001)
HERE, ELSEWHERE = Endpoint("udp:eap0", "127.0.0.1:1"), Endpoint("udp:eap0", "10.0.0.9:1")
READ, WRITE = Read(IndexGroup.SDO, 0x1018_0001, 4), Write(IndexGroup.SDO, 0x6040_0000, b"1")


def test_rules_that_change_count_at_once() -> None:
    rules: list[AccessRule] = []
    admission = GatewayAdmission(lambda: AccessList(tuple(rules)))
    assert admission.decide(HERE, TARGET, WRITE).is_allowed
    assert not admission.decide(HERE, TARGET, WRITE, by_rule=True).is_allowed
    assert admission.decide(HERE, TARGET, READ, by_rule=True).is_allowed
    assert not admission.decide(ELSEWHERE, TARGET, WRITE).is_allowed
    rules.append(AccessRule("all", services=(AccessService.WRITE,)))
    assert admission.decide(HERE, TARGET, WRITE, by_rule=True).is_allowed
    assert admission.decide(ELSEWHERE, TARGET, WRITE).is_allowed


def test_admission_records_changes_and_denials() -> None:
    admission = GatewayAdmission(AccessList)
    told: list[AuditEntry] = []
    admission.on_audit.append(told.append)
    for endpoint, operation in ((HERE, READ), (HERE, WRITE), (ELSEWHERE, WRITE)):
        admission.record(
            endpoint, TARGET, operation, admission.decide(endpoint, TARGET, operation), 0
        )
    assert [
        (each.endpoint, each.header.target_port, each.operations[0].result) for each in told
    ] == [
        (HERE, 1001, 0),
        (ELSEWHERE, 1001, AdsError.ACCESS_DENIED),
    ]


def test_guard_refuses_a_change_that_cannot_be_recorded() -> None:
    admission = GatewayAdmission(AccessList)
    recorded: list[AuditEntry] = []
    admission.before_change = lambda entry: recorded.append(entry) or "the audit cannot be written"  # type: ignore[func-returns-value]
    decision = admission.decide(HERE, TARGET, WRITE)
    assert (decision.is_allowed, decision.why) == (False, "the audit cannot be written")
    assert denial_cause(decision) is Cause.NOT_RECORDED
    assert denial_cause(admission.decide(ELSEWHERE, TARGET, WRITE)) is Cause.DENIED
    assert admission.decide(HERE, TARGET, READ).is_allowed
    assert not admission.decide(ELSEWHERE, TARGET, WRITE).is_allowed
    assert [each.operations[0].operation for each in recorded] == [WRITE]


@pytest.mark.parametrize(
    ("kind", "body", "result"),
    [
        (MailboxType.COE, "0030 60 4060 00 00000000", 0),
        (MailboxType.COE, "0020 80 4060 00 00000206", AdsError.NOT_FOUND),
        (MailboxType.COE, "0080 81 00 0000 00000000", 0),
        (MailboxType.SOE, "04 40 2000", 0),
        (MailboxType.SOE, "14 40 2000 0110", AdsError.GENERAL),
        (MailboxType.FOE, "04 00 00000000", 0),
        (MailboxType.FOE, "05 00 01800000", AdsError.GENERAL),
        (MailboxType.FOE, "06 00 00006400", AdsError.BUSY),
        (MailboxType.ERR, "0100 0200", AdsError.SERVICE),
    ],
)
def test_result_of_replies_of_a_slave(kind: MailboxType, body: str, result: int) -> None:
    assert result_of([GatewayReply(kind, bytes.fromhex(body))]) == result


def test_result_of_replies_of_the_gateway() -> None:
    refusal = error_reply(MailboxType.COE, bytes(10), Cause.TIMEOUT)
    assert result_of([GatewayReply(*refusal, reason=Cause.TIMEOUT)]) == AdsError.TIMEOUT
    assert result_of([]) is None
