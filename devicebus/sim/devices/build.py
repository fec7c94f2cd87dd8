"""Builder of a simulated segment from the description of a bus, and the kinds of devices."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from functools import partial

import msgspec

from devicebus.mailbox.soe_server import SoeParameter
from devicebus.sim.device import Behaviour, Device
from devicebus.sim.devices import drive, esi
from devicebus.sim.devices.drive import Axes
from devicebus.sim.devices.objects import INPUTS, OUTPUTS, build_dictionary, object_ids_of
from devicebus.sim.devices.protocols import build_mailbox
from devicebus.sim.devices.signal import Signals
from devicebus.sim.devices.siibuild import RAM, build_image, plan_channels
from devicebus.sim.esc import Esc, EscSettings
from devicebus.sim.segment import Cable, SimulatedSegment
from devicebus.sim.slave import SimulatedSlave
from devicebus.sim.spec import BusSpec, ChannelSpec, ClockSpec, DeviceKind, SlaveSpec
from eap.codec import datatypes
from eap.od.dictionary import ObjectDictionary

MODULAR_DEVICE = 5001
"""Object 0x1000 of devices without a profile (ETG.5001)."""
_PRODUCTS = {kind: number for number, kind in enumerate(DeviceKind, 1)}


def complete(spec: SlaveSpec, resources: Mapping[str, bytes]) -> SlaveSpec:
    """Return *spec* completed with the objects and channels of its kind.

    Raises:
        ValueError: the description of the vendor is missing or cannot be used.
    """
    if spec.kind is DeviceKind.ESI:
        if spec.esi not in resources:
            raise ValueError("a device of kind esi needs its file (key esi)")
        return esi.complete(spec, resources[spec.esi])
    if spec.kind is DeviceKind.COUPLER and (spec.inputs or spec.outputs):
        raise ValueError("a coupler has no process data, expected no inputs and no outputs")
    if spec.kind is DeviceKind.DRIVE:
        spec = drive.complete(spec)
    return msgspec.structs.replace(
        spec,
        product=spec.product or _PRODUCTS[spec.kind],
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
    spec: SlaveSpec, dictionary: ObjectDictionary, resources: Mapping[str, bytes]
) -> tuple[Behaviour | None, dict[int, list[SoeParameter]]]:
    """Return the behaviour of a device, or None, and the IDNs of each of its axes.

    Raises:
        ValueError: the source of an input is invalid.
    """
    if spec.kind is DeviceKind.DRIVE:
        axes = drive.Axes(drive.Drive(dictionary, axis) for axis in range(spec.axes))
        idns = (drive.parameters(axis, spec.name) for axis in axes.drives)
        return axes, dict(enumerate(idns))
    signals = Signals(spec, dictionary, resources)
    return signals or None, {}


_MII = 3
_NONE: Mapping[str, bytes] = {}


def build_slave(
    spec: SlaveSpec, resources: Mapping[str, bytes] = _NONE, *, ports: Iterable[int] = (0, 1)
) -> SimulatedSlave:
    """Build one slave.

    Args:
        spec: Description of the slave.
        resources: Content of the files named in *spec*.
        ports: Its ports.

    Raises:
        ValueError: a data type, a value or an entry in *spec* is invalid.
    """
    spec = complete(spec, resources)
    dictionary = build_dictionary(spec, device_type(spec))
    behaviour, drives = behave(spec, dictionary, resources)
    device = Device(
        spec.name,
        dictionary,
        behaviour=behaviour,
        has_boot=spec.boot and spec.mailbox is not None,
        needs_sync0=spec.clock is not None and spec.clock.needs_sync0,
        identification=spec.alias,
        channels=_channels(spec),
    )
    device.process_data.configure()
    layout = plan_channels(
        spec.mailbox, device.process_data.outputs.size, device.process_data.inputs.size
    )
    device.output_channel = layout.output_channel
    device.input_channel = layout.input_channel
    if spec.mailbox is not None:
        device.mailbox = build_mailbox(spec.mailbox, spec.files, device, drives)
    if isinstance(behaviour, Axes):
        for axis, drive in enumerate(behaviour.drives):
            drive.report = partial(device.report_error, axis=axis)
    emulates = spec.mailbox is None and not layout.channels[0].length + layout.channels[1].length
    image = build_image(spec, dictionary, layout, emulates=emulates, ports=ports)
    return SimulatedSlave(Esc(image, _settings(spec, ports)), device)


def build_segment(bus: BusSpec, resources: Mapping[str, bytes] = _NONE) -> SimulatedSegment:
    """Build and connect all slaves of *bus*.

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
        build_slave(spec, resources, ports=there)
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
