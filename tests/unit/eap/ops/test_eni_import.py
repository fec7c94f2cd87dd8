from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from eap.config.imports.records import ImportOutcome
from eap.config.index import DescribedSlave, ExpectedBus
from eap.errors import ConfigError
from eap.od.slave_config import IdnWrite, RevisionRule, SdoWrite, Transition
from eap.ops.imports import ImportChoices, ImportResult, run_import
from eap.runtime.busfile import describe
from eap.runtime.plantfile import load_plant
from tests.support import eni
from tests.support.pages import ROOT

CELL = ROOT / "docs" / "examples" / "Cell.xml"
LINE = ROOT / "docs" / "examples" / "Line.tsproj"
ESI = ROOT / "config" / "esi"
SIMULATED = ImportChoices(bus="sim")
INPUT = eni.pdo("TxPdo", "#x1a00", "Channel 1", ("#x6000", 1, 16, "Value", "INT"))
OUTPUT = eni.pdo("RxPdo", "#x1600", "csp", ("#x6040", 0, 16, "Controlword", "UINT"))
ONE_INPUT = eni.process_data(eni.manager(3, "Inputs", 0x1180, 0x20, 0x1A00), INPUT)


class Importer:
    """A folder with files to import."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.plant = folder / "plant.yaml"

    def put(self, text: str, name: str = "Net.xml", encoding: str = "utf-8") -> Path:
        path = self.folder / name
        path.write_bytes(text.encode(encoding))
        return path

    def run(self, *files: Path, choices: ImportChoices = SIMULATED) -> ImportResult:
        return run_import(files, self.plant, choices)[0]

    def slaves(self, text: str, choices: ImportChoices = SIMULATED) -> tuple[DescribedSlave, ...]:
        """Return the slaves of the bus file that is made of *text*."""
        result = self.run(self.put(text), choices=choices)
        assert result.ok, result.findings
        return self.bus().slaves

    def bus(self, name: str = "Net-bus.yaml") -> ExpectedBus:
        found = describe(self.folder / name)
        assert isinstance(found, ExpectedBus), found
        return found


@pytest.fixture
def importer(tmp_path: Path) -> Importer:
    return Importer(tmp_path)


def notes(result: ImportResult, outcome: ImportOutcome) -> str:
    return "\n".join(
        f"{each.item}: {each.message}" for each in result.notes if each.outcome is outcome
    )


@pytest.mark.parametrize("folder", [None, ESI])
def test_eni_of_coupler_terminals_and_drive_becomes_a_bus_with_its_names(
    importer: Importer, folder: Path | None
) -> None:
    result = importer.run(CELL, choices=ImportChoices(bus="sim", esi=folder))
    assert result.ok
    assert result.stations == ("master",)
    names = {Path(each).name for each in result.bus_files}
    assert names == {"Cell-bus.yaml"} | (set() if folder else {"Cell-bus-esi.xml"})
    loaded = load_plant(importer.plant)
    assert not loaded.findings
    coupler, outputs, inputs, analogue, drive = importer.bus("Cell-bus.yaml").slaves
    assert (coupler.name, coupler.outputs, coupler.inputs) == ("Term_1_C100", (), ())
    assert [(each.group, each.name, each.type) for each in outputs.outputs] == [
        (f"Channel {n}", "Output", "BOOL") for n in (1, 2, 3, 4)
    ]
    assert (inputs.product, inputs.revision) == (0x03EC3052, 0x00120000)
    # The ENI has no check of the revision.
    assert inputs.config.revision_rule is RevisionRule.ANY
    assert [(each.group, each.type) for each in analogue.inputs] == [
        ("AI Compact Channel 1", "INT"), ("AI Compact Channel 2", "INT"),
    ]  # fmt: skip
    assert analogue.config.assignment[3] == (0x1A01, 0x1A03)
    written = [each for each in analogue.config.writes if isinstance(each, SdoWrite)]
    assert (0x8000, 17, b"\xf6\xff") in [(w.index, w.subindex, w.data) for w in written]
    assert [each.name for each in drive.inputs] == ["Statusword", "Position actual value"]
    sync = drive.config.sync
    assert sync is not None
    signals = sync.signals(5_000_000)
    assert signals is not None
    assert (signals.activate, signals.cycle0_ns, signals.shift0_ns) == (0x0300, 5_000_000, 250_000)
    assert analogue.config.sync is None or not analogue.config.sync.activate
    left = notes(result, ImportOutcome.LEFT)
    assert "Term 6 (CAP): no station address" in left
    assert "register commands (38)" in left
    assert "Cyclic: cyclic commands with their offsets (2)" in left


def test_offsets_of_the_file_do_not_change_what_is_made_of_it(importer: Importer) -> None:
    importer.run(CELL)
    before = importer.bus("Cell-bus.yaml")
    text = CELL.read_text()
    changes = {
        "<InputOffs>29": "<InputOffs>39",
        "<OutputOffs>50": "<OutputOffs>60",
        "<BitStart>480": "<BitStart>0",
        "<BitOffs>312": "<BitOffs>9312",
    }
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    other = importer.put(text, "Other.xml")
    importer.plant = importer.folder / "other.yaml"
    assert importer.run(other).ok
    assert importer.bus("Other-bus.yaml") == before


def test_ccs_2_with_data_is_not_written_but_told(importer: Importer) -> None:
    coe = eni.sdo("#x8000", 1, "0500", ccs=2) + eni.sdo("32768", 2, "07", ccs=1)
    path = importer.put(eni.config(eni.slave("A", 1, ONE_INPUT, eni.mailbox(coe))))
    result = importer.run(path)
    (slave,) = importer.bus().slaves
    assert [(w.subindex, w.data) for w in slave.config.writes if isinstance(w, SdoWrite)] == [
        (2, b"\7")
    ]
    assert "Ccs 2 has data (0x8000:01: 05 00 on PS)" in notes(result, ImportOutcome.COMMENT)
    assert (
        "# Not written, Ccs 2 is an upload: 0x8000:01"
        in (importer.folder / "Net-bus.yaml").read_text()
    )


def test_uploads_disabled_commands_and_those_of_boot_are_left(importer: Importer) -> None:
    coe = (
        eni.sdo("#x1018", 1, "", ccs=2)
        + eni.sdo("#x8000", 1, "01", more="<Disabled>1</Disabled>")
        + eni.sdo("#x8000", 2, "01", at="IB")
        + eni.sdo("#x8000", 3, "01", at="IP BI SO")
    )
    result = importer.run(importer.put(eni.config(eni.slave("A", 1, ONE_INPUT, eni.mailbox(coe)))))
    (slave,) = importer.bus().slaves
    (write,) = (each for each in slave.config.writes if isinstance(each, SdoWrite))
    assert (write.subindex, write.at) == (3, (Transition.IP, Transition.SO))
    left = notes(result, ImportOutcome.LEFT)
    for text in ("0x1018:01: an upload", "0x8000:01: disabled", "0x8000:02: transition IB"):
        assert text in left


def test_assignment_and_mapping_by_sdo_become_keys_with_complete_access_too(
    importer: Importer,
) -> None:
    coe = (
        eni.sdo("7186", 0, "01000016", more="complete")
        + eni.sdo("#x1600", 0, "00")
        + eni.sdo("#x1600", 1, "10004060")
        + eni.sdo("#x1600", 2, "08000000")
        + eni.sdo("#x1600", 0, "02")
    )
    data = eni.process_data(eni.manager(2, "Outputs", 0x1100, 0x64, 0x1600), OUTPUT)
    (slave,) = importer.slaves(eni.config(eni.slave("A", 1, data, eni.mailbox(coe))))
    assert slave.config.assignment == {2: (0x1600,)}
    assert [(m.index, m.bit_length) for m in slave.config.mapping[0x1600]] == [(0x6040, 16), (0, 8)]
    assert slave.config.writes == ()
    assert [each.bit_length for each in slave.outputs] == [16, 8]


def test_negative_numbers_latin_text_and_receive_are_read(importer: Importer) -> None:
    text = eni.config(
        eni.slave("Gerät (X)", 1, ONE_INPUT, eni.mailbox(receive="Receive"), product="-2"),
        head='<?xml version="1.0" encoding="ISO-8859-1"?>\n',
    )
    assert importer.run(importer.put(text, encoding="latin-1")).ok
    (slave,) = importer.bus().slaves
    assert (slave.name, slave.product) == ("Gerät_X", 0xFFFFFFFE)


def test_slave_without_pdos_gets_the_names_of_the_process_image_and_a_warning(
    importer: Importer,
) -> None:
    # The image's offsets and those of the slave have different origins.
    inputs = (
        eni.variable("A.Status", "UINT", 16, 312),
        eni.variable("A.WcState.WcState", "BOOL", 1, 9000),
        eni.variable("A.Position", "DINT", 32, 328),
    )
    outputs = eni.variable("A.Odd", "BYTE", 8, 312)
    image = f"<Inputs>{''.join(inputs)}</Inputs><Outputs>{outputs}</Outputs>"
    fmmu = eni.register(1536, "00000001060000078011000101000000")
    text = eni.config(
        eni.slave("A", 1, eni.process_data(send=16, recv=48), eni.commands(fmmu)), image=image
    )
    result = importer.run(importer.put(text))
    (slave,) = importer.bus().slaves
    assert [(each.name, each.type) for each in slave.inputs] == [
        ("Status", "UINT"), ("Position", "DINT"),
    ]  # fmt: skip
    assert [(each.name, each.bit_length) for each in slave.outputs] == [("outputs", 16)]
    warned = notes(result, ImportOutcome.WARNING)
    assert "48 bits of inputs are not in the file: named by the process image" in warned
    assert "16 bits of outputs are not in the file: one block" in warned
    # The FMMU has the address.
    assert 'StartAddress="#x1180"' in (importer.folder / "Net-bus-esi.xml").read_text()


def test_fmmu_of_another_size_than_its_pdos_is_warned_of(importer: Importer) -> None:
    fmmu = eni.register(1536, "00000001060000078011000101000000")
    text = eni.config(eni.slave("A", 1, ONE_INPUT, eni.commands(fmmu)))
    result = importer.run(importer.put(text))
    assert "sync manager 3: PDOs of 16 bits, its FMMU maps 48" in notes(
        result, ImportOutcome.WARNING
    )


def test_soe_writes_reach_the_configuration_and_the_simulated_drive(importer: Importer) -> None:
    soe = eni.idn(32769, "0b00", drive=1) + eni.idn(1, "d007", more="<Comment>cycle</Comment>")
    (slave,) = importer.slaves(eni.config(eni.slave("A", 1, eni.mailbox(soe=soe))))
    assert set(slave.config.writes) == {
        IdnWrite(at=(Transition.PS,), idn=0x8001, data=b"\x0b\0", drive=1),
        IdnWrite(at=(Transition.PS,), idn=1, data=b"\xd0\x07", comment="cycle"),
    }


def test_branches_hot_connect_and_other_addresses(importer: Importer) -> None:
    def behind(port: str, address: int) -> str:
        return (
            f'<PreviousPort Selected="1"><Port>{port}</Port><PhysAddr>{address}</PhysAddr>'
            "</PreviousPort>"
        )

    hot = (
        "<HotConnect><GroupName>tool</GroupName><GroupMemberCnt>2</GroupMemberCnt><IdentifyCmd>"
        "<Cmd>1</Cmd><Ado>18</Ado><Data>0000</Data><Validate><Data>0700</Data></Validate>"
        "</IdentifyCmd></HotConnect>"
    )
    text = eni.config(
        eni.slave("A", 1, ONE_INPUT),
        eni.slave("B", 2, ONE_INPUT, behind("D", 1001)),
        eni.slave("C", 3, ONE_INPUT, behind("B", 1001)),
        eni.slave("D", 9, ONE_INPUT, hot, behind("B", 1003)),
        eni.slave("E", 10, ONE_INPUT, behind("B", 1009)),
    )
    result = importer.run(importer.put(text))
    assert result.ok, result.findings
    slaves = importer.bus().slaves
    assert [each.name for each in slaves] == ["A", "B", "C", "D", "E"]
    assert [each.config.group for each in slaves] == ["", "", "", "tool", "tool"]
    assert slaves[3].alias == 7
    bus = (importer.folder / "Net-bus.yaml").read_text()
    assert "port: 3" in bus
    assert "after: A" in bus
    assert "station address 1009: this master gives it 1004" in notes(result, ImportOutcome.LEFT)


def test_clock_times_without_activation_are_warned_of(importer: Importer) -> None:
    clock = "<DC><CycleTime0>2000000</CycleTime0><ShiftTime>-100000</ShiftTime></DC>"
    text = eni.config(eni.slave("A", 1, clock, eni.commands()), eni.slave("B", 2, ONE_INPUT, clock),
                      cyclic="<Cyclic><CycleTime>1000</CycleTime></Cyclic>")  # fmt: skip
    result = importer.run(importer.put(text))
    first, second = importer.bus().slaves
    assert first.config.sync is None
    assert second.config.sync is not None
    assert (second.config.sync.cycle0_ns, second.config.sync.shift0_ns) == (2_000_000, -100_000)
    assert "no command activates SYNC0" in notes(result, ImportOutcome.WARNING)
    assert "cycle_us: 1000" in importer.plant.read_text()


def test_bus_joins_the_station_of_a_project_that_is_imported_with_it(importer: Importer) -> None:
    choices = ImportChoices(address="127.0.9.{n}", peer="panel", bus="ethernet://eth1")
    result = importer.run(LINE, CELL, choices=choices)
    assert result.ok, result.findings
    assert result.stations == ("Line", "panel")
    text = importer.plant.read_text()
    assert (
        '{name: bus0, kind: bus, interface: "ethernet://eth1", net_id: 192.168.5.1.3.1,'
        ' bus: "Cell-bus.yaml", clocks: true}'
    ) in text


def test_bus_is_added_to_an_existing_plant_as_a_station(importer: Importer) -> None:
    assert importer.run(CELL).ok
    first = importer.plant.read_text()
    result = importer.run(CELL)
    assert (result.ok, result.stations, result.added_to) == (
        True, ("master-2",), str(importer.plant),
    )  # fmt: skip
    assert importer.plant.read_text().startswith(first.rstrip("\n"))
    assert {Path(each).name for each in result.bus_files} == {
        "Cell-bus-2.yaml", "Cell-bus-2-esi.xml",
    }  # fmt: skip


def test_esi_that_disagrees_is_not_used(importer: Importer) -> None:
    text = CELL.read_text().replace(
        "<BitLen>16</BitLen><Name>Value", "<BitLen>24</BitLen><Name>Value"
    )
    choices = ImportChoices(bus="sim", esi=ESI)
    result = importer.run(importer.put(text), choices=choices)
    assert result.ok, result.findings
    warned = notes(result, ImportOutcome.WARNING)
    assert "Term 4 (AI2): described by the ENI file, not by terminals.xml: its PDO 0x1A01" in warned


NO_IDENTITY = "<Slave><Info><PhysAddr>1</PhysAddr></Info></Slave>"
LONG = eni.pdo("TxPdo", "6656", "x", ("24576", 1, 65000, "y", "INT"))
BAD_PARTS = {
    "Data is '0g'": eni.mailbox(eni.sdo("1", 1, "0g")),
    "has no data": eni.mailbox(eni.sdo("8192", 1, "")),
    "with complete access": eni.mailbox(eni.sdo("8192", 2, "01", more="complete")),
    "Sm0 has Type 'Both'": eni.process_data(eni.manager(0, "Both", 1, 1)),
    "65000 bits": eni.process_data(eni.manager(0, "Inputs", 4096, 0, 0x1A00), LONG),
    "BitLen is 'x'": ONE_INPUT.replace("<BitLen>16", "<BitLen>x"),
    "0x1A00 is there twice": eni.process_data(INPUT, INPUT),
    "not all of which are written": eni.mailbox(eni.sdo("#x1c12", 0, "02")),
    "DriveNo is '8'": eni.mailbox(soe=eni.idn(1, "00", drive=8)),
}
BAD = {
    "it has no slave": eni.config(),
    "ProductCode is '99999999999'": eni.config(eni.slave("A", 1, product="99999999999")),
    "has no identity": eni.config(NO_IDENTITY),
    "declares entities": '<!DOCTYPE x [<!ENTITY a "b">]><EtherCATConfig/>',
    "not XML": eni.config(eni.slave("A", 1))[:-30],
    **{message: eni.config(eni.slave("A", 1, part)) for message, part in BAD_PARTS.items()},
}


@pytest.mark.parametrize("message", BAD)
def test_bad_file_is_a_finding_and_nothing_is_written(importer: Importer, message: str) -> None:
    result = importer.run(importer.put(BAD[message]))
    assert not result.ok
    assert message in "\n".join(map(str, result.findings))
    assert [each.name for each in importer.folder.iterdir()] == ["Net.xml"]


def test_all_faults_of_a_file_are_reported_at_once_with_lines(importer: Importer) -> None:
    bad = eni.slave("B", 2, eni.mailbox(eni.sdo("8192", 1, "0g")))
    text = eni.config(eni.slave("A", 1, product="x"), eni.slave("C", 3, ONE_INPUT), bad)
    result = importer.run(importer.put(text))
    assert [each.line for each in result.findings] == [3, 9]


def test_devices_of_an_esi_folder_become_a_bus_in_the_order_given(importer: Importer) -> None:
    choices = ImportChoices(bus="sim", devices=("C100", "DO4", "DO4", "SD1"), cycle_us=4000)
    result = importer.run(ESI, choices=choices)
    assert result.ok, result.findings
    slaves = importer.bus("esi-bus.yaml").slaves
    assert [each.name for each in slaves] == ["C100", "DO4", "DO4-2", "SD1"]
    assert [each.group for each in slaves[1].outputs[:2]] == ["Channel 1", "Channel 2"]
    # The settings of the vendor.
    assert slaves[3].config.sync is not None
    assert "cycle_us: 4000" in importer.plant.read_text()


def test_esi_file_alone_is_a_bus_of_its_devices_in_their_newest_revisions(
    importer: Importer,
) -> None:
    result = importer.run(ESI / "terminals.xml")
    assert result.ok, result.findings
    revisions = {each.name: each.revision for each in importer.bus("terminals-bus.yaml").slaves}
    assert revisions["DO4"] == 0x00120000


def test_unknown_device_of_esi_files_is_a_finding(importer: Importer) -> None:
    result = importer.run(ESI, choices=ImportChoices(bus="sim", devices=("DO5",)))
    assert not result.ok
    assert "DO5" in str(result.findings[0])
    assert list(importer.folder.iterdir()) == []


def test_bus_files_go_when_the_plant_file_cannot_be_written(importer: Importer) -> None:
    importer.put("plant: [", "plant.yaml")
    assert not importer.run(CELL).ok
    assert list(importer.folder.iterdir()) == [importer.plant]


def test_equal_slaves_have_one_description(importer: Importer) -> None:
    slaves = [eni.slave(f"T{number}", number, ONE_INPUT) for number in range(1, 30)]
    assert importer.run(importer.put(eni.config(*slaves))).ok
    assert (importer.folder / "Net-bus-esi.xml").read_text().count("<Device>") == 1


def test_interface_of_buses_is_checked(importer: Importer) -> None:
    with pytest.raises(ConfigError, match=r"bus 'nothing'"):
        importer.run(CELL, choices=ImportChoices(bus="nothing"))
    assert list(importer.folder.iterdir()) == []


@settings(
    max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None
)
@given(at=st.integers(0, 22_000), length=st.integers(0, 40), junk=st.text(max_size=12))
def test_damaged_files_never_crash(tmp_path: Path, at: int, length: int, junk: str) -> None:
    text = CELL.read_text()
    (tmp_path / "Net.xml").write_text(text[:at] + junk + text[at + length :], encoding="utf-8")
    result, _ = run_import([tmp_path / "Net.xml"], None, SIMULATED)
    assert result.ok or result.findings
