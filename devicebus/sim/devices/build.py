"""From the description of a bus to a segment that frames can pass."""

from __future__ import annotations

from collections.abc import Mapping

from devicebus.sim.device import Device
from devicebus.sim.devices.kinds import behave, complete, device_type
from devicebus.sim.devices.objects import build_dictionary
from devicebus.sim.devices.protocols import build_mailbox
from devicebus.sim.devices.siibuild import build_image, plan_channels
from devicebus.sim.esc import Esc, EscSettings
from devicebus.sim.segment import Cable, Segment
from devicebus.sim.slave import Slave
from devicebus.sim.spec import BusSpec, SlaveSpec

_NONE: Mapping[str, bytes] = {}


def build_slave(spec: SlaveSpec, resources: Mapping[str, bytes] = _NONE) -> Slave:
    """Make one slave; *resources* are the files that *spec* names.

    Raises:
        ValueError: a data type, a value or an entry in *spec* cannot be.
    """
    spec = complete(spec, resources)
    dictionary = build_dictionary(spec, device_type(spec))
    behaviour, parameters = behave(spec, dictionary, resources)
    device = Device(
        spec.name,
        dictionary,
        behaviour=behaviour,
        has_boot=spec.boot and spec.mailbox is not None,
        needs_sync0=spec.clock is not None and spec.clock.needs_sync0,
        identification=spec.alias,
    )
    device.process_data.configure()
    layout = plan_channels(
        spec.mailbox, device.process_data.outputs.size, device.process_data.inputs.size
    )
    device.output_channel = layout.output_channel
    device.input_channel = layout.input_channel
    if spec.mailbox is not None:
        device.mailbox = build_mailbox(spec.mailbox, spec.files, device, parameters)
    emulates = spec.mailbox is None and not layout.channels[0].length + layout.channels[1].length
    image = build_image(spec, dictionary, layout, emulates=emulates)
    return Slave(Esc(image, _settings(spec)), device)


def build_segment(bus: BusSpec, resources: Mapping[str, bytes] = _NONE) -> Segment:
    """Make all slaves of *bus* and wire them.

    Raises:
        ValueError: a slave cannot be made as described, or is wired to one that comes later.
    """
    slaves = [build_slave(spec, resources) for spec in bus.slaves]
    numbers = {spec.name: number for number, spec in enumerate(bus.slaves)}
    cables = []
    for number, spec in enumerate(bus.slaves[1:], 1):
        parent = numbers[spec.after] if spec.after else number - 1
        if parent >= number:
            raise ValueError(f"{spec.name} is wired to {spec.after}, which comes later")
        cables.append(Cable(number, parent, spec.port))
    ring_end = (len(slaves) - 1, 1) if bus.ring else None
    return Segment(slaves, cables, ring_end=ring_end, cable_ns=bus.cable_ns)


def _settings(spec: SlaveSpec) -> EscSettings:
    clock = spec.clock
    if clock is None:
        return EscSettings(has_dc=False)
    return EscSettings(drift_ppm=clock.drift_ppm, local_start_ns=clock.start_ns)
