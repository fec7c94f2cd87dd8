"""The kinds of devices: what each adds to its description, and how it behaves."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import msgspec

from devicebus.mailbox.soe_parameter import SoeParameter
from devicebus.sim.device import Behaviour
from devicebus.sim.devices import drive, driveidns, esi
from devicebus.sim.devices.signal import Signals
from devicebus.sim.spec import ChannelSpec, DeviceKind, SlaveSpec
from eap.codec import datatypes
from eap.od.dictionary import ObjectDictionary

MODULAR_DEVICE = 5001
"""Object 0x1000 of everything without a profile of its own (ETG.5001)."""
_PRODUCTS = {kind: number for number, kind in enumerate(DeviceKind, 1)}


def complete(spec: SlaveSpec, resources: Mapping[str, bytes]) -> SlaveSpec:
    """Return *spec* with everything that its kind adds.

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
    """Yield what fills the last byte of each PDO.

    Real devices with an application of their own do so, and masters count them reliably: SOEM
    expects too small a working counter of slaves that share a byte.  Devices from an ESI file have
    what the file says.
    """
    ends: dict[int, int] = {}
    for channel in channels:
        bits = channel.bits or datatypes.parse(channel.type).bit_length
        ends[channel.pdo] = ends.get(channel.pdo, 0) + bits
    for pdo, end in ends.items():
        if end % 8:
            yield ChannelSpec(name="", object="0", bits=-end % 8, pdo=pdo)


def device_type(spec: SlaveSpec) -> int:
    """Return what object 0x1000 says."""
    return drive.DEVICE_TYPE if spec.kind is DeviceKind.DRIVE else MODULAR_DEVICE


def behave(
    spec: SlaveSpec, dictionary: ObjectDictionary, resources: Mapping[str, bytes]
) -> tuple[Behaviour | None, dict[int, list[SoeParameter]]]:
    """Return the behaviour of a device, if it has one, and the IDNs of each of its axes.

    Raises:
        ValueError: an input cannot get its values from where it should.
    """
    if spec.kind is DeviceKind.DRIVE:
        axes = drive.Axes(drive.Drive(dictionary, axis) for axis in range(spec.axes))
        idns = (driveidns.parameters(axis, spec.name) for axis in axes.drives)
        return axes, dict(enumerate(idns))
    signals = Signals(spec, dictionary, resources)
    return signals or None, {}
