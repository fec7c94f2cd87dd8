"""What ties a bus to the process image of its station; replaced when the station gets another."""

from __future__ import annotations

from collections.abc import Callable

from devicebus.master.image import BusImage
from devicebus.master.master import Master
from eap.appliance.engine.bus_plan import BusPlan, BusPlanner
from eap.appliance.engine.bus_states import BusStates
from eap.pd.copyplan import CopyPlan
from eap.pd.image import Image
from eap.pd.spec import BusPortSpec, PortSpec, Writer


class BusTies:
    """The copies between a bus and an image.

    Args:
        port: The bus port.
        image: Of the station.
        memory_of: Returns where a station reads what a writer writes.

    Attributes:
        bus_image: The process data of the bus that the copies are planned for.
    """

    def __init__(
        self, port: PortSpec, image: Image, memory_of: Callable[[Writer], memoryview]
    ) -> None:
        slaves = (port.bus or BusPortSpec()).slaves
        self.bus_image: BusImage | None = None
        self._planner = BusPlanner(slaves, image.layout)
        self._states = BusStates(port.name, slaves, image)
        self._memory = memory_of(Writer.ENGINE)
        self._memory_of = memory_of
        self._plan: BusPlan | None = None
        self._outputs: list[tuple[memoryview, CopyPlan]] = []

    @property
    def missing(self) -> tuple[str, ...]:
        """Entries that the slaves do not have, one line each."""
        return self._plan.missing if self._plan is not None else ()

    def lay_out(self, bus_image: BusImage | None) -> None:
        """Plan what is copied between the station and *bus_image*."""
        self.bus_image = bus_image
        self._plan = None
        self._outputs = []
        if bus_image is None:
            return
        self._plan = self._planner.plan(bus_image.layout)
        self._outputs = [
            (self._memory_of(writer), plan) for writer, plan in self._plan.outputs.items()
        ]

    def keep_inputs(self) -> None:
        """Have the bus show what the station has, as long as its slaves say nothing new."""
        if self._plan is not None and self.bus_image is not None:
            self._plan.kept.run(self._memory, memoryview(self.bus_image.inputs))

    def take_inputs(self, master: Master) -> None:
        """Copy what the last exchange brought into the image, and where the slaves are."""
        if self._plan is not None and self.bus_image is not None:
            self._plan.inputs.run(memoryview(self.bus_image.inputs), self._memory)
        self._states.show(master)

    def put_outputs(self) -> None:
        """Copy the outputs out of the image."""
        if self.bus_image is not None:
            for memory, plan in self._outputs:
                plan.run(memory, memoryview(self.bus_image.outputs))
