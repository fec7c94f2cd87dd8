"""Rules of device descriptions: revisions, PDO assignments, modules, configurations."""

from __future__ import annotations

import msgspec
import pytest

from devicebus.esi.choice import (
    DeviceQuery,
    choose_devices,
    default_assignment,
    default_config,
    default_modules,
    find_modules,
    match_slave,
    needs_sync0,
    plan_device,
    with_modules,
)
from devicebus.esi.content import ListedDevice
from devicebus.esi.names import name_entries, process_entries
from devicebus.esi.records import (
    EsiCoe,
    EsiDevice,
    EsiInitCommand,
    EsiMailbox,
    EsiModule,
    EsiOpMode,
    EsiPdo,
    EsiPdoEntry,
    EsiSlot,
    EsiSyncManager,
    SmUse,
)
from eap.od.slave_config import OpMode, RevisionRule, SdoWrite, Transition

PRODUCT = 0x0C84_3052
REVISIONS = (0x0010_0000, 0x0012_0000, 0x0011_0000, 0x0013_0016, 0x0010_0016)
LIST = [
    ListedDevice(vendor=2, product=PRODUCT, revision=each, number=n, line=n, type="EL3204")
    for n, each in enumerate(REVISIONS)
]


def query(revision=None, **more):
    return DeviceQuery(product=PRODUCT, revision=revision)._replace(**more)


@pytest.mark.parametrize("revision", REVISIONS)
def test_revision_asked_for_is_honoured(revision):
    assert choose_devices(LIST, query(revision))[0].revision == revision


def test_revision_that_is_missing_names_the_known_ones():
    with pytest.raises(ValueError, match="no revision 0x00990000; known: 0x00100000, 0x00100016"):
        choose_devices(LIST, query(0x0099_0000))


def test_highest_revision_without_a_special_version_by_default():
    assert choose_devices(LIST, query())[0].revision == 0x0012_0000


@pytest.mark.parametrize(
    ("designation", "name", "revision"),
    [
        ("EL3204-0000-0016", "EL3204", 0x0010_0000),
        ("el3204-0000-0018", "EL3204", 0x0012_0000),
        ("EL3204-0010-0020", "EL3204-0010", 0x0014_000A),
    ],
)
def test_device_by_its_whole_designation(designation, name, revision):
    special = msgspec.structs.replace(LIST[0], revision=0x0014_000A, type="EL3204-0010")
    (found,) = choose_devices([*LIST, special], DeviceQuery(type=designation))
    assert (found.type, found.revision) == (name, revision)


def test_type_that_looks_like_a_designation_is_taken_as_it_is():
    other = msgspec.structs.replace(LIST[0], type="XR-1000-0018")
    assert choose_devices([*LIST, other], DeviceQuery(type="xr-1000-0018")) == [other]


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        ({"type": "EL3204-0000-0019"}, "EL3204 has no revision 0x00130000; known: 0x00100000"),
        (
            {"type": "EL3204-0000-0016", "revision": 0x0012_0000},
            "EL3204-0000-0016 is revision 0x00100000, not 0x00120000",
        ),
        ({"type": "EL3240-0000-0016"}, r"none of 5 devices is EL3240, did you mean EL3204\?"),
    ],
)
def test_designation_of_no_device(wanted, message):
    with pytest.raises(ValueError, match=message):
        choose_devices(LIST, DeviceQuery(**wanted))


def test_device_by_its_type():
    assert choose_devices(LIST, DeviceQuery(type="el3204"))[0].product == PRODUCT
    with pytest.raises(ValueError, match=r"EL3204 has product 0x[0-9A-F]{8}, not 0x00000005"):
        choose_devices(LIST, DeviceQuery(type="EL3204", product=5))
    with pytest.raises(ValueError, match="no device in its ESI files"):
        choose_devices([], DeviceQuery(type="EL3204"))
    with pytest.raises(ValueError, match=r"none of 5 devices is EL3240, did you mean EL3204\?"):
        choose_devices(LIST, DeviceQuery(type="EL3240"))


@pytest.mark.parametrize(
    ("slave", "description"),
    [
        (0x0011_0000, 0x0011_0000),
        (0x0019_0000, 0x0012_0000),
        (0x0012_0016, 0x0010_0016),
        (0x0013_0016, 0x0013_0016),
        (0x000F_0000, None),
        (0x0012_0020, None),
    ],
)
def test_slave_has_the_highest_revision_that_is_not_above_it(slave, description):
    found = match_slave(LIST, query(slave))
    assert (found[0].revision if found else None) == description


BUFFERS = (
    EsiSyncManager(use=SmUse.MAILBOX_OUT, start=0x1000, default_size=128),
    EsiSyncManager(use=SmUse.MAILBOX_IN, start=0x1080, default_size=128),
    EsiSyncManager(use=SmUse.OUTPUTS, start=0x1100),
    EsiSyncManager(use=SmUse.INPUTS, start=0x1180),
)


def pdo(index, sm=None, **more):
    return EsiPdo(
        index=index, name=f"P{index:X}", is_output=index < 0x1A00, sync_manager=sm, **more
    )


def device(*pdos, **more):
    mailbox = EsiMailbox(coe=EsiCoe(pdo_assign=True))
    given = {"sync_managers": BUFFERS, "mailbox": mailbox, **more}
    return EsiDevice(vendor=2, product=1, revision=0x10000, type="X", pdos=pdos, **given)


def indexes(assignment):
    return {number: [each.index for each in pdos] for number, pdos in assignment.items()}


def test_pdos_with_a_sync_manager_and_mandatory_ones_are_assigned():
    found = device(
        pdo(0x1600, 2), pdo(0x1601), pdo(0x1A01, 3), pdo(0x1A00, is_mandatory=True), pdo(0x1A02)
    )
    assert indexes(default_assignment(found)) == {2: [0x1600], 3: [0x1A01, 0x1A00]}


def test_first_of_pdos_that_exclude_each_other_is_assigned():
    found = device(pdo(0x1A00, 3), pdo(0x1A01, 3, excludes=(0x1A00,)), pdo(0x1A02, 3))
    assert indexes(default_assignment(found)) == {2: [], 3: [0x1A00, 0x1A02]}


SLOT = EsiSlot(
    idents=(1, 2), default=1, min_instances=1, max_instances=3, pdo_step=1, index_step=0x10
)
ENTRY = EsiPdoEntry(index=0x6000, subindex=1, bits=8, name="In", depends_on_slot=True)
MODULES = (
    EsiModule(
        ident=1,
        type="IN",
        pdos=(pdo(0x1A00, 3, depends_on_slot=True, entries=(ENTRY,)),),
        init_commands=(
            EsiInitCommand(transitions=("PS",), index=0x8000, data=b"\1", depends_on_slot=True),
        ),
    ),
    EsiModule(ident=2, type="OUT", pdos=(pdo(0x1600, 2),)),
)


def test_modules_move_by_the_steps_of_their_slots():
    modular = device(slots=(SLOT,), modules=MODULES)
    whole = with_modules(modular, find_modules(modular, ["IN", None, 1]))
    assert [(each.index, each.entries[0].index) for each in whole.pdos] == [
        (0x1A00, 0x6000),
        (0x1A02, 0x6020),
    ]
    assert [each.index for each in whole.init_commands] == [0x8000, 0x8020]


def test_default_modules_fill_the_slots_that_need_one():
    modular = device(slots=(SLOT,), modules=MODULES)
    assert [module.type for module in default_modules(modular)] == ["IN"]


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["INN"], r"no module 'INN' fits slot 0, did you mean IN\?"),
        ([9], "no module 0x00000009 fits slot 0"),
        (["IN"] * 4, "has 3 slots, but 4 in modules"),
    ],
)
def test_module_that_does_not_fit(names, message):
    with pytest.raises(ValueError, match=message):
        find_modules(device(slots=(SLOT,), modules=MODULES), names)


def test_two_modules_with_the_same_pdo_are_refused():
    modular = device(slots=(SLOT,), modules=MODULES)
    with pytest.raises(ValueError, match="slot 1 has PDO 0x1600, which another slot has"):
        with_modules(modular, find_modules(modular, ["OUT", "OUT"]))


def test_modules_that_the_list_of_idents_cannot_hold_are_refused():
    slot = EsiSlot(idents=(1,), max_instances=255)
    modular = device(slots=(slot,), modules=(EsiModule(ident=1, type="M"),))
    assert len(plan_device(modular, ["M"] * 255).modules) == 255
    writing = msgspec.structs.replace(modular, downloads_modules=True)
    assert default_config(plan_device(writing, ["M"] * 254)).writes[-1].data == b"\xfe"
    with pytest.raises(ValueError, match="has 255 modules, object 0xF030 lists at most 254"):
        plan_device(writing, ["M"] * 255)


def test_module_replaces_the_pdo_of_the_device():
    modular = device(pdo(0x1600), slots=(SLOT,), modules=MODULES)
    whole = with_modules(modular, find_modules(modular, ["OUT"]))
    assert [each.sync_manager for each in whole.pdos] == [2]


DC = EsiOpMode(mode=OpMode(name="DC", activate=0x0300))
FREE = EsiOpMode(mode=OpMode(name="Free", activate=0))


def test_configuration_by_default():
    described = device(
        pdo(0x1600, 2),
        pdo(0x1601),
        op_modes=(DC, FREE),
        revision_rule=RevisionRule.SAME_LOW_AT_LEAST,
        init_commands=(
            EsiInitCommand(transitions=("IP", "IB"), index=0x8000, subindex=1, data=b"\5"),
            EsiInitCommand(transitions=("BI",), index=0x8000, subindex=1, data=b"\6"),
        ),
    )
    config = default_config(plan_device(described))
    assert config.assignment == {2: (0x1600,)}
    assert not config.fixed_pdos
    assert config.writes == (SdoWrite(at=(Transition.IP,), index=0x8000, subindex=1, data=b"\5"),)
    assert config.sync == DC.mode
    assert config.revision_rule is RevisionRule.SAME_LOW_AT_LEAST


def test_configuration_of_a_simple_terminal_leaves_its_pdos():
    described = device(pdo(0x1600, 2), mailbox=None, op_modes=(FREE, DC))
    config = default_config(plan_device(described))
    assert (config.assignment, config.fixed_pdos, config.sync) == ({}, True, None)


@pytest.mark.parametrize(("modes", "needs"), [((), False), ((DC,), True), ((DC, FREE), False)])
def test_sync0_is_needed_if_every_mode_uses_it(modes, needs):
    assert needs_sync0(device(op_modes=modes)) is needs


def named(*pairs, assigned=(0x1A00, 0x1A01)):
    pdos = [
        EsiPdo(
            index=0x1A00 + n,
            name=name,
            is_output=False,
            entries=tuple(
                EsiPdoEntry(index=0x6000, subindex=n * 8 + at, bits=8, name=each)
                for at, each in enumerate(entries, 1)
            ),
        )
        for n, (name, entries) in enumerate(pairs)
    ]
    return [name for name, _ in name_entries(process_entries(pdos), assigned)]


def test_names_are_those_of_pdo_and_entry():
    assert named(("Channel 1", ["Input"]), ("Channel 2", ["Input", "TxPDO Toggle"])) == [
        "Channel_1.Input",
        "Channel_2.Input",
        "Channel_2.TxPDO_Toggle",
    ]


def test_names_that_occur_twice_have_their_objects():
    assert named(("Ch", ["A", "A"])) == ["Ch.A_6000_01", "Ch.A_6000_02"]


def test_names_of_assigned_pdos_come_first():
    found = named(("Ch", ["A"]), ("Ch", ["A"]), assigned=(0x1A01,))
    assert found == ["Ch.A", "Ch.A_6000_01"]
