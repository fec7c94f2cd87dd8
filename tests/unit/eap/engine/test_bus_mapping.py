"""A bus whose station gets another process image while it exchanges."""

from __future__ import annotations

from msgspec.structs import replace

from eap.engine.bus_mapping import BusMapping
from eap.pd.handover import ImageHandover
from eap.pd.spec import VariableSpec, Writer
from tests.support.cyclic import MS, image_of
from tests.support.enginebus import BusRig


def move(rig, ties_for=None):
    """Give the station another variable in front of all others, and the image that follows."""
    spec = replace(rig.station, variables=(VariableSpec("new", "LREAL"), *rig.station.variables))
    image = image_of(spec)
    application = memoryview(bytearray(len(image.memory)))

    def memory_of(writer):
        return image.memory if writer is Writer.ENGINE else application

    ties = (ties_for or rig.bus.prepare_mapping)(spec.ports[1], image, memory_of)
    handover = ImageHandover(rig.image, image)
    handover.carry_values(rig.application)
    handover.carry_values(rig.image.memory)
    application[:] = image.memory
    rig.bus.swap_mapping(ties)
    rig.image, rig.application = image, application


def test_the_exchange_goes_on_with_another_image(tmp_path):
    rig = BusRig(tmp_path).start()
    rig.wait_op()
    rig.set("bus0.level.limit", 1234)
    rig.run(3 * MS)
    before = rig.bus.master.cycle.stats()
    for value in (55, 66):
        move(rig)
        rig.run(3 * MS)
        assert rig.value("state") == 8
        assert rig.value("level.height") == -7
        rig.set("bus0.level.limit", value)
        rig.run(3 * MS)
        dictionary = rig.wire.segment.segment.slaves[2].device.dictionary
        assert dictionary.entry(0x7000, 1).value == value
    after = rig.bus.master.cycle.stats()
    assert (after.lost, after.wkc_errors) == (before.lost, before.wkc_errors)
    assert after.cycles == before.cycles + 12


def test_mapping_is_planned_again_for_new_bus_image(tmp_path):
    rig = BusRig(tmp_path).start()
    rig.wait_op()
    move(rig, BusMapping)
    rig.run(3 * MS)
    assert rig.value("level.height") == -7
