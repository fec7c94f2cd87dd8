"""Access rights through the gateway, and their audit."""

from __future__ import annotations

from eap.ams.access import AuditEntry
from eap.ams.spec import AccessRule, AccessService, ObjectRange
from tests.unit.eap.services.gateway.test_gateway import (
    COE,
    ELSEWHERE,
    FILE,
    FOE,
    HERE,
    SOE,
    VENDOR,
    GatewayHarness,
    play,
)

WRITE = "0020 2b 4060 00 06000000"


def test_writing_to_all_takes_a_rule() -> None:
    async def scene(harness: GatewayHarness) -> None:
        for header, body in await harness.handle(COE, 0xFFFF, WRITE):
            assert header.address == 1001
            assert body.hex().startswith("002080406000000001")

    async def allowed(harness: GatewayHarness) -> None:
        ((_, body),) = await harness.handle(COE, 0xFFFF, WRITE)
        assert body.hex().startswith("0030604060")

    play(scene)
    play(allowed, AccessRule("group", services=(AccessService.WRITE,)))


def test_other_hosts_only_read() -> None:
    async def scene(harness: GatewayHarness) -> None:
        assert (await harness.one(COE, 1001, VENDOR, ELSEWHERE)).startswith("00 30 43")
        write = "0020 2b 4060 00 06000000"
        assert (await harness.one(COE, 1001, write, ELSEWHERE)).startswith(
            "00 20 80 40 60 00 00 00 01 06"
        )
        assert (await harness.one(FOE, 1001, "02 00 00000000" + FILE, ELSEWHERE)).startswith(
            "05 00 0a 80"
        )
        assert (await harness.one(SOE, 1001, "03 40 2000 01020304", ELSEWHERE)).startswith("14")
        assert (await harness.one(COE, 1001, WRITE)).startswith("00 30 60")

    play(scene)


def test_a_rule_opens_one_object() -> None:
    rule = AccessRule(
        "control word",
        networks=("10.0.0.0/24",),
        services=(AccessService.WRITE,),
        objects=(ObjectRange(0x6040, 0x6040),),
    )

    async def scene(harness: GatewayHarness) -> None:
        assert (await harness.one(COE, 1001, "0020 2b 4060 00 06000000", ELSEWHERE)).startswith(
            "00 30 60"
        )
        other = "0020 23 0080 01 06000000"
        assert (await harness.one(COE, 1001, other, ELSEWHERE)).startswith("00 20 80")

    play(scene, rule)


def test_changes_and_refusals_are_audited() -> None:
    async def scene(harness: GatewayHarness) -> None:
        entries: list[AuditEntry] = []
        harness.gateway.admission.on_audit.append(entries.append)
        await harness.one(COE, 1001, VENDOR, ELSEWHERE)
        assert not entries
        await harness.one(COE, 1001, WRITE, ELSEWHERE)
        await harness.one(COE, 1001, WRITE)
        await harness.handle(COE, 0xFFFF, WRITE)
        told = [
            (each.endpoint, each.header.target_port, each.operations[0].result) for each in entries
        ]
        assert told == [(ELSEWHERE, 1001, 0x723), (HERE, 1001, 0), (HERE, 1001, 0x723)]
        assert entries[2].operations[0].decision.why == (
            "only a rule allows it for several slaves at once"
        )

    play(scene)


def test_access_to_a_remote_file_is_decided_at_its_opening() -> None:
    async def scene(harness: GatewayHarness) -> None:
        refused = await harness.one(FOE, 0x9001, "02 00 00000000" + FILE, ELSEWHERE)
        assert refused.startswith("05 00 0a 80 00 00")
        step = await harness.one(FOE, 0x9001, "03 00 01000000 61", ELSEWHERE)
        assert step.startswith("05 00 04 80 00 00")
        assert not harness.station.asked
        await harness.one(FOE, 0x9001, "01 00 00000000" + FILE, ELSEWHERE)
        assert harness.station.asked, "reading takes no rule"

    play(scene)


def test_audit_has_the_result_of_a_change() -> None:
    async def scene(harness: GatewayHarness) -> None:
        entries: list[AuditEntry] = []
        harness.gateway.admission.on_audit.append(entries.append)
        await harness.one(COE, 1001, "0020 2b 5555 00 06000000")
        await harness.handle(COE, 1009, WRITE)
        await harness.ask_frame(bytes.fromhex("0e50 0800 e903 0030 0020 20 4060 00 0600"))
        await harness.ask_frame(bytes.fromhex("0e50 0800 e903 0030 0020 20 5555 00 0600"))
        operations = [each.operations[0] for each in entries]
        assert [each.result for each in operations] == [0x70C, 6, 0, 0x700]
        assert [each.operation.data for each in operations[:2]] == [b"\6\0", b"\6\0"]

    play(scene)
