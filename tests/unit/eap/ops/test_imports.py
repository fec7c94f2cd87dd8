from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.config.imports.records import EapBox, EapImportDevice, EapVariable, ImportOutcome
from eap.config.imports.stations import PublisherIdentity
from eap.config.imports.treeitems import tree_items_text
from eap.config.load import Plant
from eap.errors import ConfigError, EnvironmentalError
from eap.ids import NetId
from eap.ops.imports import ImportChoices, ImportResult, run_import
from eap.runtime.plantfile import load_plant
from tests.support.pages import ROOT
from tests.support.twincat import (
    DEVICE,
    device,
    instance,
    links,
    project,
    publisher,
    subscriber,
)

LINE = ROOT / "docs" / "examples" / "Line.tsproj"
SPEED = ("Speed", 11, "DINT", 4)
RUNNING = ("Running", 12, "BOOL", 1)
UDP = ImportChoices(address="127.0.9.{n}")


class Importer:
    """A folder with files to import."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.plant = folder / "plant.yaml"

    def put(self, name: str, text: str) -> Path:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        return path

    def run(self, *files: Path, choices: ImportChoices = UDP) -> ImportResult:
        return run_import(files, self.plant, choices)[0]

    def import_project(self, *devices: str, choices: ImportChoices = UDP) -> ImportResult:
        return self.run(self.put("Line.tsproj", project(*devices)), choices=choices)

    def loaded(self, path: Path | None = None) -> Plant:
        found = load_plant(path or self.plant)
        assert not found.findings
        assert found.plant is not None
        return found.plant

    @property
    def text(self) -> str:
        return self.plant.read_text()


@pytest.fixture
def importer(tmp_path: Path) -> Importer:
    return Importer(tmp_path)


def comments(result: ImportResult) -> list[str]:
    return [each.message for each in result.notes if each.outcome is ImportOutcome.COMMENT]


def messages(result: ImportResult) -> list[str]:
    return [each.message for each in result.findings]


def test_project_and_its_peer_become_a_plant_without_findings(importer: Importer) -> None:
    choices = ImportChoices(address="127.0.9.{n}", peer="panel")
    result = importer.run(LINE, choices=choices)
    assert (result.ok, result.stations) == (True, ("Line", "panel"))
    line, panel = importer.loaded().stations
    assert [(pd.pd_id, pd.variables) for frame in line.frames for pd in frame.pds] == [
        (11, ("Speed",)), (12, ("Running",)), (13, ("Axis",)), (14, ("Recipe",)), (15, ("Mode",)),
    ]  # fmt: skip
    assert {frame.destination for frame in line.frames} == {"127.0.9.2"}
    assert {each.publisher for each in line.subscriptions} == {str(panel.ports[0].net_id)}
    assert [each.pd_id for each in panel.subscriptions] == [11, 12, 13, 14, 15]
    assert {each.publisher for each in panel.subscriptions} == {"192.168.5.1.2.1"}
    types = {each.name: each.type for each in line.variables}
    assert types["Recipe"] == "STRING(21)"
    assert types["Running"] == "BOOL8"
    assert types["Axis"].startswith("ST_Axis<16/8:")
    # The unicast target of the project is the NetID that it expects of its publishers too.
    assert str(panel.ports[0].net_id) == "192.168.5.2.1.1"
    assert line.cycle_us == panel.cycle_us == 10_000


def test_two_projects_find_each_other(importer: Importer) -> None:
    line = importer.put("Line.tsproj", project(device(publisher("State", SPEED))))
    press = project(
        device(subscriber("In", SPEED, eap='Publisher="c0a805010101"'), net_id="192.168.5.2.2.1"),
        target='TargetNetId="192.168.5.2.1.1"',
    )
    result = importer.run(line, importer.put("Press.tsproj", press))
    assert result.stations == ("Line", "Press")
    assert "from: Line/Speed" in importer.text
    assert "to: Press/eap0" in importer.text
    _, receiver = importer.loaded().stations
    assert receiver.subscriptions[0].publisher == "192.168.5.1.2.1"


@pytest.mark.parametrize(
    ("identity", "net_ids"),
    [("device", ("192.168.5.1.1.1", "192.168.5.1.2.1")),
     ("system", ("192.168.5.1.2.1", "192.168.5.1.1.1"))],
)  # fmt: skip
def test_both_readings_of_the_publisher_are_offered(
    importer: Importer, identity: str, net_ids: tuple[str, str]
) -> None:
    choices = ImportChoices(address="ethernet://eth0", identity=PublisherIdentity(identity))
    result = importer.import_project(
        device(publisher("State", SPEED), subscriber("In", ("V", 5, "INT", 2))), choices=choices
    )
    assert result.ok
    (station,) = importer.loaded().stations
    assert (str(station.net_id), str(station.ports[0].net_id)) == net_ids
    other = "system" if identity == "device" else "device"
    assert f"--publisher {other}" in " ".join(importer.text.replace("#", " ").split())
    # The expected publisher as the project has it, and the other reading beside.
    assert "publisher: 192.168.5.2.1.1, id: 5" in importer.text
    assert "# publisher: 192.168.5.2.2.1 instead" in importer.text


@pytest.mark.parametrize(
    ("box", "reason"),
    [
        (publisher("A", SPEED, eap='InOut="1"'), "the file does not say where it sends to"),
        (publisher("A", SPEED, box='Disabled="true"'), "disabled in the project"),
        (publisher("A", SPEED, eap='Publisher="c0a805020101" X="1"'), 'line 1: Eap X="1"'),
        (publisher("A", SPEED, more='OnChange="1"'), 'EapVar OnChange="1"'),
        (publisher("A", SPEED, ("Other", 11, "INT", 2)), "NvId 11 of Other is that of Speed too"),
        (publisher("A"), "it has no variable that can be sent"),
    ],
)  # fmt: skip
def test_publisher_that_is_not_certain_becomes_a_comment(
    importer: Importer, box: str, reason: str
) -> None:
    choices = ImportChoices(address="ethernet://eth0")
    result = importer.import_project(device(box), choices=choices)
    assert result.ok
    (comment,) = comments(result)
    assert reason in comment
    (station,) = importer.loaded().stations
    assert not station.frames
    assert "# - {name: A, port: eap0" in importer.text
    assert reason in " ".join(importer.text.replace("#", " ").split())


def test_missing_destination_is_taken_from_the_option(importer: Importer) -> None:
    choices = ImportChoices(address="ethernet://eth0", to="multicast")
    importer.import_project(device(publisher("A", SPEED, eap='InOut="1"')), choices=choices)
    (station,) = importer.loaded().stations
    assert station.frames[0].destination == "01:01:05:04:00:00"


def test_unicast_to_a_controller_elsewhere_needs_no_option_on_ethernet(importer: Importer) -> None:
    importer.import_project(
        device(publisher("A", SPEED)), choices=ImportChoices(address="ethernet://eth0")
    )
    (station,) = importer.loaded().stations
    assert station.frames[0].destination == "192.168.5.2.1.1"
    assert station.frames[0].monitor_interval_ms == 1000


def test_unicast_to_a_controller_elsewhere_is_a_comment_on_udp(importer: Importer) -> None:
    result = importer.import_project(device(publisher("A", SPEED)))
    (comment,) = comments(result)
    assert "to 192.168.5.2.1.1, which udp://127.0.9.1 cannot reach" in comment
    assert not importer.loaded().stations[0].frames


def test_variables_of_one_name_are_told_apart_by_their_boxes(importer: Importer) -> None:
    boxes = [
        publisher(f"Box {n} (Publisher)", ("Var 1", n, "INT", 2), eap='InOut="1"') for n in (1, 2)
    ]
    importer.import_project(
        device(*boxes), choices=ImportChoices(address="ethernet://eth0", to="multicast")
    )
    (station,) = importer.loaded().stations
    assert [each.name for each in station.variables if "." not in each.name] == [
        "Var_1", "Box_2_Publisher-Var_1",
    ]  # fmt: skip
    assert [frame.name for frame in station.frames] == ["Box_1_Publisher", "Box_2_Publisher"]


def test_cycles_of_several_tasks(importer: Importer) -> None:
    mapping = links("A", ("Fast Outputs^a", "Speed^Outputs^VarData")) + links(
        "B", ("Slow Outputs^b", "Running^Outputs^VarData")
    )
    text = project(
        device(publisher("A", SPEED, eap='InOut="1"'), publisher("B", RUNNING, eap='InOut="1"')),
        plc=instance(("Fast", 2_000), ("Slow", 10_000)),
        mappings=mapping,
    )
    choices = ImportChoices(address="ethernet://eth0", to="multicast")
    importer.run(importer.put("Line.tsproj", text), choices=choices)
    (station,) = importer.loaded().stations
    assert station.cycle_us == 2_000
    assert [frame.pds[0].trigger.cycle_us for frame in station.frames] == [0, 10_000]


@pytest.mark.parametrize(
    ("tasks", "why"),
    [([], "no task in the files"), ([("A", 1_000), ("B", 2_000)], "several tasks, and none has")],
)
def test_publisher_of_unknown_cycle_is_a_comment_until_it_is_given(
    importer: Importer, tasks: list[tuple[str, int]], why: str
) -> None:
    path = importer.put("Line.tsproj", project(device(publisher("A", SPEED)), tasks=tasks))
    (comment,) = comments(importer.run(path, choices=ImportChoices()))
    assert f"its cycle is not known ({why}" in comment
    importer.plant.unlink()
    result = importer.run(path, choices=ImportChoices(cycle_us=4_000))
    assert not comments(result)
    (station,) = importer.loaded().stations
    assert (station.cycle_us, len(station.frames)) == (4_000, 1)


def test_task_that_is_no_multiple_makes_a_comment(importer: Importer) -> None:
    mapping = links("A", ("Fast Outputs^a", "Speed^Outputs^VarData")) + links(
        "B", ("Slow Outputs^b", "Running^Outputs^VarData")
    )
    text = project(
        device(publisher("A", SPEED), publisher("B", RUNNING)),
        plc=instance(("Fast", 2_000), ("Slow", 5_000)),
        mappings=mapping,
    )
    path = importer.put("Line.tsproj", text)
    result = importer.run(path, choices=ImportChoices(address="ethernet://eth0"))
    assert comments(result) == [
        "not sent: the task of Running has a cycle of 5000 us, no multiple of 2000 us"
    ]


def test_type_with_another_size_than_its_members_is_refused_with_both_layouts(
    importer: Importer,
) -> None:
    types = (
        "<DataType><Name>ST_A</Name><BitSize>96</BitSize><SubItem><Name>b</Name><Type>BYTE</Type>"
        "<BitSize>8</BitSize><BitOffs>0</BitOffs></SubItem><SubItem><Name>r</Name><Type>LREAL</Type>"
        "<BitSize>64</BitSize><BitOffs>64</BitOffs></SubItem></DataType>"
    )
    box = publisher("A", ("V", 1, "ST_A", 12), ("W", 2, "ST_A", 12))
    result = importer.run(importer.put("Line.tsproj", project(device(box), types=types)))
    assert not result.ok
    assert not importer.plant.exists()
    (layout,) = (each for each in result.findings if each.path == "ST_A")
    assert (Path(layout.file).name, layout.line) == ("Line.tsproj", 1)
    assert "given" in layout.expected
    assert "computed" in layout.expected
    assert [each for each in messages(result) if "cannot be used" in each] == [
        "V: its type ST_A cannot be used", "W: its type ST_A cannot be used",
    ]  # fmt: skip


def test_variable_with_another_length_than_its_type_is_refused(importer: Importer) -> None:
    result = importer.import_project(device(publisher("A", ("V", 1, "DINT", 5))))
    assert messages(result) == ["V has 5 bytes, its type DINT has 4"]
    assert not importer.plant.exists()


def test_variable_that_is_no_whole_bytes_is_refused(importer: Importer) -> None:
    box = EapBox(
        name="Out", is_publisher=True, variables=(EapVariable(name="V", nv_id=1, type="X", bits=4),)
    )
    xml = tree_items_text([EapImportDevice(name="EAP", boxes=(box,))])
    result = importer.run(importer.put("Line.xml", xml))
    assert messages(result) == ["V has 4 bits, no whole bytes"]


def test_type_that_no_file_has_is_a_block_with_a_warning(importer: Importer) -> None:
    result = importer.import_project(
        device(publisher("A", ("V", 1, "ST_Far", 12))),
        choices=ImportChoices(address="ethernet://eth0"),
    )
    assert result.ok
    assert [each.type for each in importer.loaded().stations[0].variables][:1] == ["BLOCK(12)"]
    warnings = [each.message for each in result.notes if each.outcome is ImportOutcome.WARNING]
    assert "type ST_Far is in none of the files: BLOCK(12) is taken" in warnings[0]


@pytest.mark.parametrize(
    ("kind", "size"),
    [("POINTER TO INT", 0), ("ST_P", 8)],
)
def test_pointers_are_refused(importer: Importer, kind: str, size: int) -> None:
    types = (
        "<DataType><Name>ST_P</Name><BitSize>64</BitSize><SubItem><Name>p</Name>"
        '<Type PointerTo="1">INT</Type><BitSize>64</BitSize><BitOffs>0</BitOffs></SubItem>'
        "</DataType>"
    )
    text = project(device(publisher("A", ("V", 1, kind, size))), types=types)
    result = importer.run(importer.put("Line.tsproj", text))
    assert not result.ok
    assert not importer.plant.exists()


@pytest.mark.parametrize(
    ("name", "text", "reason"),
    [
        ("a.tszip", "PK", "it is an archive: unpack it"),
        ("a.xml", "<TcConfig/>", "'eapctl routes import STATION FILE' takes the routes of it"),
        ("a.xml", "<EtherCATInfo/>", "it describes no device"),
        ("a.xti", '<TcSmItem><Box BoxType="9099"/></TcSmItem>', "nothing in it can be imported"),
        ("a.tsproj", project(device(more='Disabled="1"')), "nothing in it can be imported"),
    ],
)
def test_files_without_process_data_are_refused_with_the_reason(
    importer: Importer, name: str, text: str, reason: str
) -> None:
    result = importer.run(importer.put(name, text))
    assert not result.ok
    assert reason in messages(result)[0]
    assert not importer.plant.exists()


@pytest.mark.parametrize("address", ["127.0.9.{n}", "ethernet://eth0"])
def test_peer_sends_once_what_two_projects_expect(importer: Importer, address: str) -> None:
    press = LINE.read_text().replace("192.168.5.1.", "192.168.7.1.")
    # Of the same publisher: one PD in common, the others of its own.
    for number in (22, 23, 24):
        press = press.replace(f'NvId="{number}"', f'NvId="{number + 10}"')
    choices = ImportChoices(address=address, peer="panel")
    result = importer.run(LINE, importer.put("Press.tsproj", press), choices=choices)
    assert result.findings == ()
    *both, panel = importer.loaded().stations
    sent = {frame.name: [pd.pd_id for pd in frame.pds] for frame in panel.frames}
    assert sent == {"to-all": [21], "to-Line": [22, 23, 24], "to-Press": [32, 33, 34]}
    assert [[each.pd_id for each in station.subscriptions] for station in both] == [
        [21, 22, 23, 24],
        [21, 32, 33, 34],
    ]


def test_gateway_of_udp_frames_is_a_comment(importer: Importer) -> None:
    variable = EapVariable(name="V", nv_id=1, type="DINT", bits=32)
    box = EapBox(
        name="B", is_publisher=True, udp="10.0.0.7", gateway="10.1.0.1", variables=(variable,)
    )
    text = tree_items_text([EapImportDevice(name="D", cycle_us=10_000, boxes=(box,))])
    assert importer.run(importer.put("d.xml", text)).ok
    assert "# in the project by gateway 10.1.0.1: here the routes of the host" in importer.text


def test_file_that_is_named_twice_is_refused_once(importer: Importer) -> None:
    result = importer.run(LINE, LINE)
    assert messages(result) == ["it is named twice"]


def test_projects_of_one_controller_are_refused_with_both_files(importer: Importer) -> None:
    first = importer.put("A.tsproj", LINE.read_text())
    second = importer.put("B.tsproj", LINE.read_text())
    result = importer.run(first, second)
    assert [(each.file, each.message) for each in result.findings] == [
        (str(second), f"its NetID 192.168.5.1.1.1 is that of {first} too")
    ]
    assert not importer.plant.exists()


def test_plant_without_a_file_is_checked_too() -> None:
    choices = ImportChoices(address="127.0.9.{n}", to="nonsense")
    result, _ = run_import((LINE,), None, choices)
    assert not result.ok
    assert "'nonsense' is not an IPv4 address" in messages(result)[0]


@pytest.mark.parametrize("choices", [ImportChoices(plant="a b"), ImportChoices(peer="a b")])
def test_name_with_a_space_is_refused(choices: ImportChoices) -> None:
    with pytest.raises(ConfigError, match="name 'a b': expected a text without spaces"):
        run_import((LINE,), None, choices)


def test_plant_in_a_file_with_spaces_has_a_name_without(importer: Importer) -> None:
    importer.plant = importer.folder / "my plant.yaml"
    assert importer.run(LINE).plant == "my_plant"
    assert importer.loaded().name == "my_plant"


def test_folder_without_esi_files_is_refused(importer: Importer) -> None:
    result = importer.run(importer.folder)
    assert messages(result) == ["it describes no device"]
    importer.plant = importer.folder / "none" / "plant.yaml"
    with pytest.raises(EnvironmentalError, match="cannot be written: No such file"):
        importer.run(LINE)


def test_system_without_a_net_id_gets_one_that_its_devices_do_not_have(importer: Importer) -> None:
    variable = EapVariable(name="V", nv_id=1, type="DINT", bits=32)
    box = EapBox(name="B", is_publisher=True, udp="127.0.9.7", variables=(variable,))
    net_id = NetId.parse("5.1.2.3.1.1")
    device_ = EapImportDevice(name="D", net_id=net_id, cycle_us=10_000, boxes=(box,))
    assert importer.run(importer.put("d.xml", tree_items_text([device_]))).findings == ()
    (station,) = importer.loaded().stations
    assert (str(station.net_id), str(station.ports[0].net_id)) == ("5.1.2.3.2.1", "5.1.2.3.1.1")
    assert "import with --publisher system" in " ".join(importer.text.replace("#", " ").split())


@given(st.data())
def test_damaged_projects_are_imported_or_refused(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    octets = bytearray(LINE.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(octets) - 1))
        match data.draw(st.sampled_from(("cut", "change", "remove", "repeat"))):
            case "cut":
                del octets[at + 1 :]
            case "change":
                octets[at] = data.draw(st.integers(0, 255))
            case "remove":
                del octets[at : at + data.draw(st.integers(1, 200))]
            case _:
                octets[at:at] = octets[at : at + data.draw(st.integers(1, 200))]
        if not octets:
            break
    folder = tmp_path_factory.getbasetemp() / "damaged"
    folder.mkdir(exist_ok=True)
    (folder / "Line.tsproj").write_bytes(octets)
    plant = folder / "line.yaml"
    plant.unlink(missing_ok=True)
    result, _ = run_import([folder / "Line.tsproj"], plant, UDP)
    assert result.ok == plant.exists()
    assert result.ok or result.findings
    if result.ok:
        assert not load_plant(plant).findings


def test_all_findings_come_at_once_and_nothing_is_written(importer: Importer) -> None:
    files = [
        importer.put("a.tsproj", "<TcSmProject>"),
        importer.put("b.tsproj", project(device(publisher("A", ("V", -1, "INT", 2))))),
        importer.put("c.xml", "<Other/>"),
        importer.put("d.edc", "<Anything/>"),
        importer.folder / "gone.tsproj",
        importer.folder,
    ]
    result = importer.run(*files)
    assert {Path(each.file).name for each in result.findings} == {
        "a.tsproj", "b.tsproj", "c.xml", "d.edc", "gone.tsproj", importer.folder.name,
    }  # fmt: skip
    (edc,) = (each for each in messages(result) if "EDC" in each)
    assert "no public description" in edc
    assert not importer.plant.exists()


def test_stations_are_added_to_a_plant_file(importer: Importer) -> None:
    before = "# Mine.\nplant: hall\nstations:\n  - name: own\n    net_id: 9.9.9.9.1.1  # keep\n"
    before += (
        '    ports: [{name: eap0, kind: eap, interface: "udp://127.0.9.99", net_id: 9.9.9.9.2.1}]\n'
    )
    importer.plant.write_text(before)
    result = importer.run(LINE, choices=ImportChoices(address="127.0.9.{n}", peer="panel"))
    assert (result.added_to, result.file, result.why_beside) == (
        str(importer.plant), str(importer.plant), ""
    )  # fmt: skip
    assert all(line in importer.text.splitlines() for line in before.splitlines())
    assert [each.name for each in importer.loaded().stations] == ["own", "Line", "panel"]


def test_stations_that_cannot_be_added_are_written_beside(importer: Importer) -> None:
    choices = ImportChoices(address="127.0.9.{n}", peer="panel")
    importer.run(LINE, choices=choices)
    before = importer.text
    result = importer.run(LINE, choices=choices)
    assert importer.text == before
    assert result.file == str(importer.folder / "plant-import.yaml")
    assert "NetID 192.168.5.1.1.1 is used twice" in result.why_beside
    importer.loaded(Path(result.file))
    assert importer.run(LINE, choices=choices).file.endswith("plant-import1.yaml")


def test_second_project_with_the_same_types_is_added(importer: Importer) -> None:
    importer.run(LINE)
    text = LINE.read_text().replace("192.168.5.1.", "192.168.5.9.").replace("c0a80502", "c0a80509")
    other = importer.put("Other.tsproj", text)
    result = importer.run(other, choices=ImportChoices(address="127.0.9.9"))
    assert result.why_beside == ""
    assert [each.name for each in importer.loaded().stations] == ["Line", "Other"]
    assert importer.text.count("ST_Axis: {members") == 1


def test_plant_file_with_errors_is_not_touched(importer: Importer) -> None:
    importer.plant.write_text("plant: x\nstations: []\n")
    result = importer.run(LINE)
    assert not result.ok
    assert importer.text == "plant: x\nstations: []\n"
    assert [Path(each.file).name for each in result.findings] == ["plant.yaml"]


def test_symbols_of_a_tmc_file_become_variables(importer: Importer) -> None:
    tmc = (
        "<TcModuleClass><DataTypes><DataType><Name>E_M</Name><BitSize>16</BitSize><BaseType>INT"
        "</BaseType><EnumInfo><Text>Off</Text><Enum>0</Enum></EnumInfo></DataType></DataTypes>"
        '<Modules><Module><DataAreas><DataArea><AreaNo AreaType="OutputSrc">1</AreaNo>'
        "<Symbol><Name>MAIN.mode</Name><BitSize>16</BitSize><BaseType>E_M</BaseType></Symbol>"
        "<Symbol><Name>MAIN.text</Name><BitSize>648</BitSize><BaseType>STRING(80)</BaseType></Symbol>"
        "<Symbol><Name>MAIN.list</Name><BitSize>32</BitSize><BaseType>INT</BaseType><ArrayInfo>"
        "<LBound>1</LBound><Elements>2</Elements></ArrayInfo></Symbol>"
        "<Symbol><Name>MAIN.bare</Name><BaseType>INT</BaseType></Symbol>"
        "<Symbol><Name>MAIN.mode</Name><BitSize>16</BitSize><BaseType>INT</BaseType></Symbol>"
        "<Symbol><Name>a b</Name><BitSize>16</BitSize><BaseType>INT</BaseType></Symbol>"
        "<Symbol><Name>MAIN.odd</Name><BitSize>8</BitSize><BaseType>LREAL</BaseType></Symbol>"
        "<Symbol><Name>MAIN.far</Name><BitSize>8</BitSize><BaseType>FB_X</BaseType></Symbol>"
        '</DataArea><DataArea><AreaNo AreaType="Internal">3</AreaNo><Symbol><Name>hidden</Name>'
        "<BitSize>8</BitSize><BaseType>BYTE</BaseType></Symbol></DataArea></DataAreas></Module>"
        "</Modules></TcModuleClass>"
    )
    result = importer.run(importer.put("axis.tmc", tmc))
    assert result.ok
    assert [(each.item, each.outcome) for each in result.notes] == [
        ("MAIN.mode", ImportOutcome.TAKEN), ("MAIN.text", ImportOutcome.TAKEN),
        ("MAIN.list", ImportOutcome.TAKEN), ("MAIN.bare", ImportOutcome.TAKEN),
        ("MAIN.mode", ImportOutcome.LEFT), ("a b", ImportOutcome.LEFT),
        ("MAIN.odd", ImportOutcome.LEFT), ("MAIN.far", ImportOutcome.LEFT),
    ]  # fmt: skip
    (station,) = importer.loaded().stations
    assert station.name == "axis"
    assert {each.name: each.type for each in station.variables} == {
        "MAIN.mode": "E_M<INT:Off=0>",
        "MAIN.text": "STRING(81)",
        "MAIN.list": "INT[1..2]",
        "MAIN.bare": "INT",
    }


def test_tree_items_become_a_station(importer: Importer) -> None:
    boxes = (
        EapBox(
            name="Out", is_publisher=True, udp="239.1.2.3", divider=2,
            variables=(EapVariable(name="V", nv_id=1, type="STRING(80)", bits=648, version=3),),
        ),
        EapBox(
            name="In", is_publisher=False, udp="239.1.2.4",
            variables=(EapVariable(name="W", nv_id=2, type="LREAL", bits=64, version=4),),
        ),
    )  # fmt: skip
    eap = EapImportDevice(
        name="EAP", net_id=NetId.parse("5.1.2.3.2.1"), cycle_us=4_000, boxes=boxes
    )
    result = importer.run(importer.put("Line.xml", tree_items_text([eap])))
    assert result.ok
    (station,) = importer.loaded().stations
    (frame,) = station.frames
    assert (frame.destination, frame.divider, frame.pds[0].version) == ("239.1.2.3", 2, 3)
    assert (station.cycle_us, station.ports[0].join) == (4_000, ("239.1.2.4",))
    (received,) = station.subscriptions
    assert (received.publisher, received.pd_id, received.version) == ("", 2, 4)


def test_address_pattern_that_is_no_interface_is_refused(importer: Importer) -> None:
    with pytest.raises(ConfigError, match="address 'x://'"):
        importer.run(LINE, choices=ImportChoices(address="x://"))


def test_devices_of_one_net_id_are_refused(importer: Importer) -> None:
    text = project(device(name="A"), device(name="B"), device(name="C", net_id="192.168.5.1.1.1"))
    result = importer.run(importer.put("Line.tsproj", text))
    assert messages(result) == [
        "B: its AmsNetId 192.168.5.1.2.1 is that of A too",
        "C: its AmsNetId 192.168.5.1.1.1 is that of the system too",
    ]


def test_project_without_any_net_id_gets_one_of_its_address(importer: Importer) -> None:
    text = project(device(net_id=""), target='TargetNetId="0.0.0.0.0.0"')
    result = importer.run(importer.put("Line.tsproj", text))
    (station,) = importer.loaded().stations
    assert (str(station.net_id), str(station.ports[0].net_id)) == (
        "127.0.9.1.1.1", "127.0.9.1.2.1"
    )  # fmt: skip
    assert "no NetID in the project: 127.0.9.1.1.1 is made up" in result.notes[0].message


def test_disabled_device_is_left(importer: Importer) -> None:
    text = project(device(publisher("A", SPEED), more='Disabled="true"'))
    result = importer.run(importer.put("Line.tsproj", text))
    assert [(each.item, each.outcome, each.message) for each in result.notes][:1] == [
        (DEVICE, ImportOutcome.LEFT, "disabled in the project")
    ]


def test_project_elsewhere_is_read_with_its_files(importer: Importer) -> None:
    folder = importer.folder / "p" / "_Config" / "IO"
    folder.mkdir(parents=True)
    text = LINE.read_text()
    start = text.index('<Device Id="1"')
    end = text.index("</Device>", start) + len("</Device>")
    (folder / "EAP.xti").write_text(f"<TcSmItem>{text[start:end]}</TcSmItem>")
    moved = f'{text[:start]}<Device File="EAP.xti" Id="1"/>{text[end:]}'
    choices = ImportChoices(address="127.0.9.{n}", peer="panel")
    result = importer.run(importer.put("p/Line.tsproj", moved), choices=choices)
    assert result.ok
    other = importer.folder / "other"
    other.mkdir()
    shutil.copy(LINE, other)
    whole = run_import([other / "Line.tsproj"], None, choices)[1]
    assert importer.text.replace("plant: plant", "plant: Line") == whole
