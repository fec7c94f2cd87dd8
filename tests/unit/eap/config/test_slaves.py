"""Keys that configure a slave: what they make of its description, and their findings."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from eap.config.document import convert_to, read
from eap.config.finding import FindingReport
from eap.config.index import DescribedPdo, DescribedPdoEntry, DescribedSlave
from eap.config.slaves import check_cycles, configure, override
from eap.config.structs import SlaveSection
from eap.od.model import RO, RW_PREOP
from eap.od.slave_config import (
    IdnWrite,
    MappedObject,
    OpMode,
    RevisionRule,
    SdoWrite,
    SlaveConfig,
    StateTimeouts,
    SyncSignals,
    Transition,
    Watchdogs,
)

MS = 1_000_000


def entry(name, index, bits=16, kind="UINT", subindex=0, manager=0):
    return DescribedPdoEntry(name, kind, index, subindex, bits, manager)


CONTROL, TARGET = entry("control", 0x6040), entry("target", 0x607A, 32, "DINT")
STATUS, POSITION = entry("status", 0x6041), entry("position", 0x6064, 32, "DINT")
SPEED = entry("speed", 0x606C, 32, "DINT")
DRIVE = DescribedSlave(
    name="drive",
    vendor=1,
    product=2,
    revision=0x10,
    pdos=(
        DescribedPdo(index=0x1600, name="CSP", is_output=True, manager=2, mandatory=True,
                     excludes=(0x1601,), entries=(CONTROL, TARGET)),
        DescribedPdo(index=0x1601, name="Short", is_output=True, manager=2, assigned=False,
                     entries=(CONTROL,)),
        DescribedPdo(index=0x1602, name="Lamp", is_output=True, manager=2, assigned=False,
                     entries=(entry("lamp", 0x2000, 1, "BOOL"),)),
        DescribedPdo(index=0x1A00, name="Status", is_output=False, manager=3,
                     entries=(STATUS, POSITION)),
        DescribedPdo(index=0x1A01, name="Fixed", is_output=False, manager=3, assigned=False,
                     fixed=True, entries=(SPEED,)),
    ),
    outputs=(CONTROL, TARGET),
    inputs=(STATUS, POSITION),
    objects=(entry("mode", 0x6060, 8, "SINT"), entry("name", 0x2001, 64, "STRING(8)")),
    op_modes=(OpMode(name="DC-Synchron", activate=0x0730, factor1=1),),
    managers={2: True, 3: False},
)  # fmt: skip


def read_keys(tmp_path, text):
    path = tmp_path / "slave.yaml"
    path.write_text(text)
    report = FindingReport("s")
    return convert_to(SlaveSection, read(path, report), report, "slave"), report


def configured(tmp_path, text, slave=DRIVE):
    keys, report = read_keys(tmp_path, text)
    found = configure(slave, keys, report)
    assert [str(each) for each in report.findings()] == []
    return found


def names(entries):
    return [each.name for each in entries]


def test_slave_without_keys_is_as_described(tmp_path):
    assert configured(tmp_path, "{}") == DRIVE


def test_list_of_pdos_replaces_those_of_their_direction(tmp_path):
    found = configured(tmp_path, "pdos: [CSP, 0x1602]")
    assert found.config.assignment == {2: (0x1600, 0x1602)}
    assert names(found.outputs) == ["control", "target", "lamp"]
    assert found.inputs == tuple(replace(each, manager=3) for each in DRIVE.inputs)
    found = configured(tmp_path, "pdos: [Status, Fixed]")
    assert found.config.assignment == {3: (0x1A00, 0x1A01)}


def test_pdos_by_sync_manager(tmp_path):
    found = configured(tmp_path, "pdos: {2: [0x1600], 3: []}")
    assert found.config.assignment == {2: (0x1600,), 3: ()}
    assert found.inputs == ()


def test_mapping_by_names_objects_and_lengths(tmp_path):
    found = configured(
        tmp_path, 'mapping: {0x1A00: [status, mode, "0x606C", "0/8", "0x2002:01/16"]}'
    )
    assert found.config.mapping == {
        0x1A00: (
            MappedObject(0x6041, 0, 16),
            MappedObject(0x6060, 0, 8),
            MappedObject(0x606C, 0, 32),
            MappedObject(0, 0, 8),
            MappedObject(0x2002, 1, 16),
        )
    }
    # A PDO is changed while it is not assigned, so its assignment is written again.
    assert found.config.assignment == {3: (0x1A00,)}
    assert names(found.inputs) == ["status", "mode", "speed", "", ""]
    assert [each.type for each in found.inputs] == ["UINT", "SINT", "DINT", "", "UINT"]


def test_mapping_of_a_telegram_keeps_its_control_word(tmp_path):
    words = (entry("control word", 134), entry("position", 47, 32, "DINT"))
    mdt = DescribedPdo(index=24, name="MDT", is_output=True, manager=2, entries=words)
    drive = replace(DRIVE, pdos=(mdt,), outputs=words, inputs=(), has_coe=False)
    found = configured(tmp_path, "mapping: {24: [position, S-0-0036/32]}", drive)
    assert [each.index for each in found.config.mapping[24]] == [134, 47, 36]
    assert [each.index for each in found.outputs] == [134, 47, 36]


def test_start_up_writes_have_values_of_the_described_type(tmp_path):
    found = configured(
        tmp_path,
        """
startup:
  - {sdo: "0x6060", value: -1}
  - {transition: [IP, SO], sdo: 0x8000:1, data: 0a 00, complete: true, comment: c}
  - {sdo: "0x9000", value: 2.5, type: REAL}
  - {transition: OS, idn: P-0-0001, value: 2000, type: UINT, drive: 1}
  - {sdo: "0x2001", value: ab}
""",
    )
    assert found.config.writes == (
        SdoWrite(index=0x6060, data=b"\xff"),
        SdoWrite(at=(Transition.IP, Transition.SO), index=0x8000, subindex=1, data=b"\x0a\0",
                 complete=True, comment="c"),
        SdoWrite(index=0x9000, data=b"\0\0\x20\x40"),
        IdnWrite(at=(Transition.OS,), idn=0x8001, data=b"\xd0\x07", drive=1),
        SdoWrite(index=0x2001, data=b"ab" + bytes(6)),
    )  # fmt: skip


def test_later_write_to_the_same_object_replaces_in_its_place(tmp_path):
    first = configured(tmp_path, 'startup: [{sdo: "0x6060", value: 1}, {sdo: "9000", data: "01"}]')
    both = configured(
        tmp_path, 'startup: [{sdo: "0x6060", value: 8}, {sdo: "9001", data: "02"}]', first
    )
    assert [(each.index, each.data) for each in both.config.writes] == [
        (0x6060, b"\x08"),
        (0x9000, b"\x01"),
        (0x9001, b"\x02"),
    ]


def test_sync0_by_itself_follows_the_bus(tmp_path):
    found = configured(tmp_path, "sync0: {shift_us: -2.5}")
    assert found.config.sync.signals(MS) == SyncSignals(
        activate=0x0300, cycle0_ns=MS, shift0_ns=-2500
    )


def test_sync1_and_activate_change_the_mode(tmp_path):
    found = configured(tmp_path, "sync0: {cycle_us: 500}\nsync1: {cycle_us: 1000, shift_us: 20}")
    assert found.config.sync.signals(MS) == SyncSignals(
        activate=0x0700, cycle0_ns=MS // 2, cycle1_ns=MS // 2 + 20_000
    )
    found = configured(tmp_path, "dc: DC-Synchron\nsync0: {shift_us: 10}")
    assert found.config.sync.signals(MS) == SyncSignals(
        activate=0x0730, cycle0_ns=MS, shift0_ns=10_000
    )
    assert configured(tmp_path, "activate: 0", found).config.sync.signals(MS) is None


def test_other_keys_are_taken_as_they_are(tmp_path):
    found = configured(
        tmp_path,
        """
optional: true
group: tool
revision: 0x20
revision_rule: at_least
serial: 7
alias: 5
identification: id
watchdog: {process_data_ms: 50, enabled: true}
timeouts: {preop_ms: 100}
""",
    )
    assert (found.revision, found.serial, found.alias) == (0x20, 7, 5)
    assert found.config == SlaveConfig(
        optional=True,
        group="tool",
        revision_rule=RevisionRule.AT_LEAST,
        identification=0x0134,
        watchdogs=Watchdogs(process_data_ms=50, enabled=True),
        timeouts=StateTimeouts(preop_ms=100),
    )
    assert configured(tmp_path, "identification: 0x0700").config.identification == 0x700


@pytest.mark.parametrize(
    ("text", "finding"),
    [
        ("pdos: [Short]", "drive: PDO 0x1600 (CSP) is mandatory, but not assigned"),
        ("pdos: [CSP, Short]", "drive: PDO 0x1600 (CSP) excludes 0x1601 (Short); expected one of"),
        ("pdos: [CSP, 0x1600]", "drive: PDO 0x1600 is assigned twice; expected each PDO once"),
        ("pdos: [CPS]", "drive has no PDO 'CPS', did you mean CSP?; expected one of 0x1600 (CSP)"),
        ("pdos: {3: [CSP]}", "is an output, sync manager 3 has inputs; expected sync manager 2"),
        ("pdos: {x: [CSP]}", "'x' is no sync manager; expected a number from 0 to 15"),
        ("pdos: CSP", "pdos is 'CSP'; expected a mapping or a list"),
        ("mapping: {0x1A01: [status]}", "drive: the mapping of PDO 0x1A01 (Fixed) is fixed"),
        ("mapping: {0x1A09: [status]}", "drive has no PDO '0x1A09'"),
        (
            "mapping: {0x1A00: [states]}",
            "drive: 'states' cannot be mapped, did you mean status?; expected",
        ),
        ('mapping: {0x1A00: ["0x2009"]}', "drive: '0x2009' cannot be mapped"),
        ('mapping: {0x1A00: ["0x2009/256"]}', "drive: '0x2009/256' cannot be mapped"),
        ('startup: [{sdo: "0x6060"}]', "start-up write of 0x6060 without data; expected one of"),
        ('startup: [{sdo: "0x6060", value: 1, data: "01"}]', "start-up write of 0x6060 without"),
        ('startup: [{sdo: "0x6060", value: 200}]', "0x6060 of drive: 200"),
        (
            'startup: [{sdo: "0x6060", data: "0102"}]',
            "0x6060 of drive: 2 bytes of data; expected 1 bytes",
        ),
        ('startup: [{sdo: "0x6060", data: "0x1"}]', "data '0x1'; expected hexadecimal bytes"),
        ('startup: [{sdo: "0x9000", value: 1}]', "the type of 0x9000 of drive is not known; exp"),
        ('startup: [{sdo: "0x9000", value: 1, type: UNIT}]', "'UNIT' is not a data type"),
        ('startup: [{sdo: "mode", value: 1}]', "'mode' is not INDEX[:SUB] in hexadecimal"),
        ('startup: [{sdo: "0x9000:2", data: "01", complete: true}]', "complete access to 0x9000"),
        ("startup: [{value: 1}]", "start-up write without a target; expected one of sdo and idn"),
        ('startup: [{idn: S0, data: "01"}]', "'S0' is not an IDN"),
        ('startup: [{transition: SS, sdo: "9000", data: "01"}]', "'SS' is no transition; expected"),
        ("startup: [{transition: 5}]", "'5' is no transition; expected one of IP, PS, SO"),
        ("dc: DC-Sync", "drive has no mode 'DC-Sync', did you mean DC-Synchron?; expected one of"),
        ("pdos: {16: [CSP]}", "'16' is no sync manager"),
        (f"pdos: {{{'9' * 900}: [CSP]}}", "is no sync manager"),
        (
            f"mapping: {{0x1A00: [{', '.join(['status'] * 255)}]}}",
            "drive: 255 entries in PDO 0x1A00 (Status); expected at most 254",
        ),
        ("sync1: {}", "drive: SYNC1 without SYNC0; expected sync0 beside sync1"),
        ("sync0: {cycle_us: 0}", "cycle_us is 0; expected a whole number of microseconds from 1"),
        ("identification: switch", "identification 'switch'; expected one of alias, id, serial"),
        ("watchdog: {process_data_ms: 7000}", "expected a whole number of milliseconds from 0 to"),
        ("optionl: true", "unknown key 'optionl', did you mean optional?"),
    ],
)
def test_finding_about_a_key(tmp_path, text, finding):
    keys, report = read_keys(tmp_path, text)
    configure(DRIVE, keys, report)
    found = [str(each) for each in report.findings()]
    assert any(finding in each for each in found), found
    assert all(each.startswith("s:1: ") for each in found)


@pytest.mark.parametrize(
    ("lacks", "text", "finding"),
    [
        ("has_coe", 'startup: [{sdo: "0x6060", value: 1}]', "drive has no mailbox with CoE for"),
        ("has_soe", 'startup: [{idn: S-0-0001, data: "0100"}]', "drive has no mailbox with SoE"),
        ("has_clock", "sync0: {}", "drive has no distributed clock; expected no SYNC0"),
    ],
)
def test_finding_about_what_the_slave_lacks(tmp_path, lacks, text, finding):
    keys, report = read_keys(tmp_path, text)
    configure(replace(DRIVE, **{lacks: False}), keys, report)
    assert [finding in str(each) for each in report.findings()] == [True]


@pytest.mark.parametrize(
    ("text", "has_coe", "is_refused"),
    [
        ("pdos: [CSP, 0x1602]", True, True),
        ("pdos: [CSP]", True, False),
        ("pdos: {3: []}", False, False),
    ],
)
def test_fixed_assignment_can_be_changed_without_coe_only(tmp_path, text, has_coe, is_refused):
    keys, report = read_keys(tmp_path, text)
    configure(replace(DRIVE, has_coe=has_coe, config=SlaveConfig(fixed_pdos=True)), keys, report)
    found = [str(each) for each in report.findings()]
    assert ["its PDO assignment is fixed" in each for each in found] == [True] * is_refused


@pytest.mark.parametrize(
    ("cycle_us", "fits"), [(250, True), (1000, True), (500, True), (2000, True), (300, False)]
)
def test_sync0_must_fit_the_cycle_of_the_bus(cycle_us, fits):
    slave = replace(DRIVE, config=SlaveConfig(sync=OpMode(cycle0_ns=cycle_us * 1000)))
    report = FindingReport("p")
    check_cycles({"drive": slave}, 1000, report, "ports[0]")
    found = [str(each) for each in report.findings()]
    expected = ["p: drive: SYNC0 every 300 µs does not fit the cycle of 1000 µs; expected a mul"]
    assert [each[: len(expected[0])] for each in found] == ([] if fits else expected)


@pytest.mark.parametrize(
    ("mode", "text"),
    [
        (OpMode(shift0_ns=10**30), "SYNC0 shifted by 1e+27 µs does not fit the register"),
        (OpMode(activate=0x700, shift1_ns=-10), "SYNC1 after -0.01 µs does not fit the register"),
        (OpMode(factor0=5000), "SYNC0 every 5e+06 µs does not fit the register; expected 0 to"),
    ],
)
def test_times_must_fit_their_registers(mode, text):
    report = FindingReport("p")
    check_cycles({"drive": replace(DRIVE, config=SlaveConfig(sync=mode))}, 1000, report, "ports[0]")
    (finding,) = report.findings()
    assert f"drive: {text}" in str(finding)


def test_plant_keys_go_over_those_of_the_bus_file():
    report = FindingReport("p")
    keys = {"drive": SlaveSection(optional=True), "drvie": SlaveSection()}
    (found,) = override([DRIVE], keys, report, "ports[0].slaves")
    assert found.config.optional
    (finding,) = report.findings()
    assert str(finding) == "p: unknown slave 'drvie', did you mean drive?; expected one of drive"


@pytest.mark.parametrize(
    ("write", "warning"),
    [
        ('{sdo: "0x2003", value: 1}', "0x2003:00 of drive is read-only by its description"),
        ('{sdo: "0x2004", value: 1}', ""),
        (
            '{transition: [PS, SO], sdo: "0x2004", value: 1}',
            "0x2004:00 of drive is read-only in SAFEOP by its description",
        ),
        ('{transition: IP, sdo: "0x2004", value: 1}', ""),
        ('{sdo: "0x2001", data: "0000000000000000"}', ""),
        ('{sdo: "0x2003", complete: true, data: "0000"}', ""),
    ],
)
def test_write_of_an_object_that_is_read_only_is_a_warning(tmp_path, write, warning):
    objects = (
        *DRIVE.objects,
        replace(entry("serial", 0x2003), access=RO),
        replace(entry("filter", 0x2004), access=RW_PREOP),
    )
    keys, report = read_keys(tmp_path, f"startup:\n  - {write}\n")
    configure(replace(DRIVE, objects=objects), keys, report)
    assert report.findings() == ()
    assert [each.message for each in report.warnings] == ([warning] if warning else [])
    assert all(each.line == 2 for each in report.warnings)
