"""Builder of a simulated segment from the description of a bus, and the kinds of devices."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from functools import partial

import msgspec

from devicebus.esi.choice import EsiPlan, plan_device
from devicebus.esi.records import EsiDevice
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.mailbox.soe_server import SoeParameter
from devicebus.sim.device import Behaviour, Device
from devicebus.sim.devices import drive, esi, esi_image
from devicebus.sim.devices.drive import Axes
from devicebus.sim.devices.objects import INPUTS, OUTPUTS, build_dictionary, object_ids_of
from devicebus.sim.devices.protocols import build_mailbox
from devicebus.sim.devices.signal import Signals
from devicebus.sim.devices.siibuild import RAM, build_image, plan_channels
from devicebus.sim.devices.soe_drive import SoeAxes, soe_parameters
from devicebus.sim.esc import Esc, EscSettings
from devicebus.sim.segment import Cable, SimulatedSegment
from devicebus.sim.slave import SimulatedSlave
from devicebus.sim.spec import BusSpec, ChannelSpec, ClockSpec, DeviceKind, SlaveSpec
from eap.codec import datatypes
from eap.od.dictionary import ObjectDictionary

MODULAR_DEVICE = 5001
"""Object 0x1000 of devices without a profile (ETG.5001)."""
_PRODUCTS = {kind: number for number, kind in enumerate(DeviceKind, 1)}


def complete(spec: SlaveSpec) -> SlaveSpec:
    """Return *spec* completed with the objects and channels of its kind.

    Raises:
        ValueError: the description cannot be used.
    """
    if spec.kind is DeviceKind.COUPLER and (spec.inputs or spec.outputs):
        raise ValueError("a coupler has no process data, expected no inputs and no outputs")
    if spec.kind is DeviceKind.DRIVE:
        spec = drive.complete(spec)
    return msgspec.structs.replace(
        spec,
        product=spec.product or _PRODUCTS[spec.kind],
        revision=_REVISION if spec.revision is None else spec.revision,
        inputs=(*spec.inputs, *_padding(spec.inputs)),
        outputs=(*spec.outputs, *_padding(spec.outputs)),
    )


def _padding(channels: Iterable[ChannelSpec]) -> Iterator[ChannelSpec]:
    """Yield the padding of the last byte of each PDO."""
    # Real devices with an application pad their PDOs, and SOEM expects too small a working counter
    # of slaves that share a byte. Devices from an ESI file have the padding of the file.
    ends: dict[int, int] = {}
    for channel in channels:
        bits = channel.bits or datatypes.parse(channel.type).bit_length
        ends[channel.pdo] = ends.get(channel.pdo, 0) + bits
    for pdo, end in ends.items():
        if end % 8:
            yield ChannelSpec(name="", object="0", bits=-end % 8, pdo=pdo)


def device_type(spec: SlaveSpec) -> int:
    """Return the value of object 0x1000."""
    return drive.DEVICE_TYPE if spec.kind is DeviceKind.DRIVE else MODULAR_DEVICE


def behave(
    spec: SlaveSpec, dictionary: ObjectDictionary, resources: Mapping[str, bytes], axes: int
) -> Behaviour | None:
    """Return the behaviour of a device with *axes* axes, or None.

    Raises:
        ValueError: the source of an input is invalid.
    """
    if axes:
        return drive.Axes(drive.Drive(dictionary, axis) for axis in range(axes))
    return Signals(spec, dictionary, resources) or None


_MII = 3
_REVISION = 0x0001_0000
_NONE: Mapping[str, bytes] = {}
_NO_DEVICES: Mapping[str, EsiDevice] = {}


def build_slave(
    spec: SlaveSpec,
    resources: Mapping[str, bytes] = _NONE,
    device: EsiDevice | None = None,
    *,
    ports: Iterable[int] = (0, 1),
) -> SimulatedSlave:
    """Build one slave.

    Args:
        spec: Description of the slave.
        resources: Content of the files named in *spec*.
        device: Its description by the vendor, for kind esi.
        ports: Its ports.

    Raises:
        ValueError: a data type, a value or an entry in *spec* is invalid.
    """
    if spec.kind is DeviceKind.ESI:
        if device is None:
            raise ValueError("a device of kind esi needs its description (key esi)")
        return _build_esi(spec, resources, plan_device(device, spec.modules), ports)
    spec = complete(spec)
    dictionary = build_dictionary(spec, device_type(spec))
    axes = spec.axes if spec.kind is DeviceKind.DRIVE else 0
    behaviour = behave(spec, dictionary, resources, axes)
    unit = Device(
        spec.name,
        dictionary,
        behaviour=behaviour,
        has_boot=spec.boot and spec.mailbox is not None,
        needs_sync0=spec.clock is not None and bool(spec.clock.needs_sync0),
        identification=spec.alias,
        channels=_channels(spec),
    )
    unit.process_data.configure()
    outputs, inputs = unit.process_data.channels
    layout = plan_channels(spec.mailbox, outputs.size, inputs.size)
    outputs.number, inputs.number = layout.output_channel, layout.input_channel
    if spec.mailbox is not None:
        sizes = MailboxSizes(spec.mailbox.size, spec.mailbox.size)
        drives = _drive_parameters(behaviour, spec.name)
        unit.mailbox = build_mailbox(spec.mailbox, spec.files, unit, sizes, drives)
    _connect_reports(unit)
    emulates = spec.mailbox is None and not layout.channels[0].length + layout.channels[1].length
    image = build_image(spec, dictionary, layout, emulates=emulates, ports=ports)
    return SimulatedSlave(Esc(image, _settings(spec, ports)), unit)


def _build_esi(
    spec: SlaveSpec, resources: Mapping[str, bytes], plan: EsiPlan, ports: Iterable[int]
) -> SimulatedSlave:
    """Build a slave with the layout of its vendor's description."""
    spec = esi.complete(spec, plan)
    dictionary = esi.build_dictionary(spec, plan, MODULAR_DEVICE)
    axes = esi.axes_of(dictionary) if esi.is_drive(spec, dictionary) else 0
    drive.add_missing(dictionary, axes)
    behaviour: Behaviour | None
    if plan.device.is_soe and plan.device.mailbox is not None:
        behaviour = SoeAxes(dictionary, plan.device.mailbox.soe_channels)
    else:
        behaviour = behave(spec, dictionary, resources, axes)
    unit = Device(
        spec.name,
        dictionary,
        behaviour=behaviour,
        has_boot=spec.boot,
        needs_sync0=spec.clock is not None and bool(spec.clock.needs_sync0),
        identification=spec.alias,
        process_channels=esi.process_channels(plan),
        channels=esi.channel_names(spec),
    )
    unit.process_data.configure()
    sizes = esi.mailbox_sizes(plan.device)
    if spec.mailbox is not None and sizes is not None:
        drives = _drive_parameters(behaviour, spec.name)
        if plan.device.is_soe:
            drives = soe_parameters(plan.device, dictionary)
        unit.mailbox = build_mailbox(spec.mailbox, spec.files, unit, MailboxSizes(*sizes), drives)
    _connect_reports(unit)
    settings = msgspec.structs.replace(
        _settings(spec, ports), ram=esi.memory_size(plan, unit.process_data.channels)
    )
    return SimulatedSlave(Esc(esi_image.build_image(spec, plan), settings), unit)


def _drive_parameters(behaviour: Behaviour | None, name: str) -> dict[int, list[SoeParameter]]:
    """Return the IDNs of each axis of a drive."""
    if not isinstance(behaviour, Axes):
        return {}
    idns = (drive.parameters(axis, name) for axis in behaviour.drives)
    return dict(enumerate(idns))


def _connect_reports(unit: Device) -> None:
    """Report faults of axes by emergencies."""
    if isinstance(unit.behaviour, Axes):
        for number, axis in enumerate(unit.behaviour.drives):
            axis.report = partial(unit.report_error, axis=number)


def build_segment(
    bus: BusSpec,
    resources: Mapping[str, bytes] = _NONE,
    devices: Mapping[str, EsiDevice] = _NO_DEVICES,
) -> SimulatedSegment:
    """Build and connect all slaves of *bus*; *devices* are those of kind esi by their names.

    Raises:
        ValueError: the description of a slave is invalid, or it is connected to a later slave.
    """
    numbers = {spec.name: number for number, spec in enumerate(bus.slaves)}
    cables = []
    for number, spec in enumerate(bus.slaves[1:], 1):
        parent = numbers[spec.after] if spec.after else number - 1
        if parent >= number:
            raise ValueError(f"{spec.name} is wired to {spec.after}, which comes later")
        cables.append(Cable(number, parent, spec.port))
    ports = [{0, 1} for _ in bus.slaves]
    for cable in cables:
        ports[cable.parent].add(cable.parent_port)
    slaves = [
        build_slave(spec, resources, devices.get(spec.name), ports=there)
        for spec, there in zip(bus.slaves, ports, strict=True)
    ]
    ring_end = (len(slaves) - 1, 1) if bus.ring else None
    return SimulatedSegment(slaves, cables, ring_end=ring_end, cable_ns=bus.cable_ns)


def _channels(spec: SlaveSpec) -> dict[str, tuple[int, int]]:
    """Return the entries of inputs and outputs by their names, without ambiguous names."""
    channels = (*spec.inputs, *spec.outputs)
    found = (*object_ids_of(spec.inputs, INPUTS), *object_ids_of(spec.outputs, OUTPUTS))
    counts = Counter(channel.name for channel in channels)
    return {
        channel.name: place
        for channel, place in zip(channels, found, strict=True)
        if place[0] and counts[channel.name] == 1
    }


def _settings(spec: SlaveSpec, ports: Iterable[int]) -> EscSettings:
    clock = spec.clock or ClockSpec()
    return EscSettings(
        ram=RAM,
        port_descriptor=sum(_MII << 2 * port for port in ports),
        has_dc=spec.clock is not None,
        drift_ppm=clock.drift_ppm,
        local_start_ns=clock.start_ns,
    )
