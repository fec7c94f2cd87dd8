"""EEPROM images made from descriptions."""

from __future__ import annotations

import pytest

from devicebus.sim.devices.objects import build_dictionary
from devicebus.sim.devices.siibuild import IMAGE_SIZE, build_image, plan_channels
from devicebus.sim.spec import ChannelSpec, MailboxSpec
from devicebus.wire import sii
from devicebus.wire.sii import SiiProtocol
from tests.support.bus import generic


def image_of(spec, *, emulates=False):
    layout = plan_channels(spec.mailbox, 3, 3)
    return build_image(spec, build_dictionary(spec, 5001), layout, emulates=emulates)


def test_channels_with_a_mailbox():
    layout = plan_channels(MailboxSpec(size=100), 3, 5)
    assert [(c.start, c.length, c.control, c.type) for c in layout.channels] == [
        (0x1000, 100, 0x26, 1), (0x1064, 100, 0x22, 2), (0x10C8, 3, 0x64, 3), (0x1128, 5, 0x20, 4),
    ]  # fmt: skip
    assert layout[1:] == (2, 3)


@pytest.mark.parametrize(("outputs", "inputs"), [(0, 4), (4, 0), (1000, 1000)])
def test_areas_have_room_for_three_buffers(outputs, inputs):
    layout = plan_channels(None, outputs, inputs)
    first, second = layout.channels
    assert first.start + 3 * outputs <= second.start
    assert [each.enable for each in layout.channels] == [bool(outputs), bool(inputs)]
    assert layout[1:] == (0, 1)


def test_process_data_that_no_controller_holds():
    with pytest.raises(ValueError, match="expected at most 8192"):
        plan_channels(MailboxSpec(size=1024), 1100, 1100)


def test_names_of_pdos_and_entries():
    read = sii.decode(image_of(generic("island")))
    ((rx, outputs),), ((tx, inputs),) = read.rx_pdos, read.tx_pdos
    assert (read.string(rx.name), read.string(tx.name)) == ("Outputs", "Inputs")
    assert [read.string(each.name) for each in outputs] == ["speed", "valve"]
    assert [read.string(each.name) for each in inputs] == ["level", "limit"]
    assert len(set(read.strings)) == len(read.strings)
    assert read.general.coe_pdo_configuration == 1


def test_names_that_an_eeprom_cannot_hold():
    inputs = (ChannelSpec(name="Ω"), ChannelSpec(name="x" * 256),
              *(ChannelSpec(name=f"a{n}") for n in range(252)))  # fmt: skip
    read = sii.decode(image_of(generic(inputs=inputs[:250], outputs=inputs[250:])))
    assert [read.string(each.name) for each in read.tx_pdos[0].entries][:3] == ["", "", "a0"]
    assert len(read.strings) == 255
    assert read.rx_pdos[0].entries[-2].name == read.tx_pdos[0].entries[-3].name == 0 or (
        read.strings[-1].startswith("a")
    )


def test_sii_image_grows_with_its_content():
    inputs = tuple(ChannelSpec(name=f"input number {n}", type="USINT") for n in range(250))
    image = image_of(generic(inputs=inputs))
    assert len(image) == 8192
    assert sii.decode(image).fixed.size == 63


def test_pdos_that_are_not_assigned_come_last():
    inputs = (
        ChannelSpec(name="spare", pdo=0x1A00, assigned=False),
        ChannelSpec(name="b", pdo=0x1A02),
        ChannelSpec(name="a", pdo=0x1A01),
    )
    read = sii.decode(image_of(generic(inputs=inputs)))
    assert [(pdo.header.index, pdo.header.sync_manager) for pdo in read.tx_pdos] == [
        (0x1A02, 3), (0x1A01, 3), (0x1A00, 0xFF),
    ]  # fmt: skip
    assert read.string(read.tx_pdos[0].header.name) == "Inputs 2"


def test_sii_image_has_the_ports():
    spec = generic()
    layout = plan_channels(spec.mailbox, 3, 3)
    dictionary = build_dictionary(spec, 5001)
    image = build_image(spec, dictionary, layout, emulates=False, ports=(0, 1, 3))
    assert sii.decode(image).general.port_physics == 0x1011


def test_sii_image_describes_the_slave():
    mailbox = MailboxSpec(size=64, foe=True, soe=True, eoe=True, voe=True, aoe=True)
    spec = generic(
        "valve island", alias=9, vendor=1, product=2, revision=3, serial=4, mailbox=mailbox
    )
    image = image_of(spec)
    assert (len(image), sii.is_intact(image)) == (IMAGE_SIZE, True)
    read = sii.decode(image)
    fixed = read.fixed
    assert (read.name, read.fmmus[:3]) == ("valve island", (1, 2, 3))
    identity = (fixed.alias, fixed.vendor, fixed.product, fixed.revision, fixed.serial)
    assert identity == (9, 1, 2, 3, 4)
    assert (fixed.receive_offset, fixed.send_offset, fixed.boot_send_size) == (0x1000, 0x1040, 64)
    assert fixed.protocols == (
        SiiProtocol.COE
        | SiiProtocol.FOE
        | SiiProtocol.SOE
        | SiiProtocol.EOE
        | SiiProtocol.VOE
        | SiiProtocol.AOE
    )
    ((header, entries),) = read.tx_pdos
    assert (header.index, header.sync_manager) == (0x1A00, 3)
    assert [e.bit_length for e in entries] == [16, 1]
    assert [e.data_type for e in entries] == [6, 1]


def test_image_of_a_slave_without_mailbox_boot_and_clock():
    spec = generic(mailbox=None, boot=False, clock=None, inputs=())
    read = sii.decode(image_of(spec, emulates=True))
    assert (read.fixed.protocols, read.fixed.receive_size, read.fixed.boot_receive_size) == (
        0,
        0,
        0,
    )
    assert (read.fixed.pdi_control, read.dc, read.tx_pdos) == (0x0104, (), ())
    assert read.general.coe_sdo == 0
