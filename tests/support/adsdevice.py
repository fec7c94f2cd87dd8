"""Devices with ADS services whose variables lie in a dict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from eap.ads.device import AdsDevice
from eap.ads.io import IoDevice, IoDeviceType, IoSpace, MasterSpace, SlaveState
from eap.ads.request import AdsRefusedError, WriteControl
from eap.ads.space import OP, SAFEOP, SystemSpace, al_state_for, states_of
from eap.ads.symbols import SymbolSpace, SymbolTable, SymbolVariable
from eap.codec import datatypes
from eap.codec.ads import AdsDeviceInfo, AdsError, AdsState, AdsStates, AdsSystemState, device_name
from eap.codec.datatypes import Part, find_variable
from eap.ids import NetId

BUS_NET_ID = NetId.parse("5.23.91.23.2.1")
VALUES = {
    "motor.speed": ("REAL", 1.5),
    "motor.on": ("BOOL", True),
    "count": ("UDINT", 70_000),
    "depth": ("INT24", -3),
    "mode": ("BIT3", 5),
    "name": ("STRING(15)", "pump"),
    "curve": ("INT[4]", (1, -2, 3, -4)),
    "raw": ("BLOCK(3)", b"\1\2\3"),
    "long": ("LINT", -(1 << 40)),
    "flags": ("WORD", 0x8001),
    "wide": ("UINT40[2]", (1, 1 << 39)),
    "exact": ("LREAL", 0.1),
}
READ_ONLY = "count"


class DictStore:
    """Values as octets; *broken* names are refused with what it says."""

    def __init__(self, values: Mapping[str, tuple[str, object]] = VALUES) -> None:
        self.types = {name: datatypes.parse(kind) for name, (kind, _) in values.items()}
        self.octets = {n: self.types[n].encode(value) for n, (_, value) in values.items()}
        self.broken: dict[str, AdsError] = {}

    def set(self, name, value) -> None:
        self.octets[name] = self.types[name].encode(value)

    def get(self, name):
        return self.types[name].decode(self.octets[name], 0)

    def read(self, name: str) -> bytes:
        if name in self.broken:
            raise AdsRefusedError(self.broken[name])
        variable, part = self._find(name)
        offset, bit = divmod(part.bit_offset, 8)
        if part.kind.is_bits and variable != name:
            return bytes((self.octets[variable][offset] >> bit & (1 << part.kind.bit_length) - 1,))
        return self.octets[variable][offset : offset + part.kind.size]

    def write(self, name: str, octets: bytes) -> None:
        if name in self.broken:
            raise AdsRefusedError(self.broken[name])
        variable, part = self._find(name)
        assert len(octets) == part.kind.size
        whole = bytearray(self.octets[variable])
        offset, bit = divmod(part.bit_offset, 8)
        if part.kind.is_bits and variable != name:
            mask = (1 << part.kind.bit_length) - 1 << bit
            whole[offset] = whole[offset] & ~mask | octets[0] << bit
        else:
            whole[offset : offset + len(octets)] = octets
        self.octets[variable] = bytes(whole)

    def _find(self, name: str) -> tuple[str, Part]:
        found = find_variable(name, self.types.get)
        assert found is not None
        return found


def variables(store: DictStore) -> list[SymbolVariable]:
    return [
        SymbolVariable(name, kind, f"comment of {name}", "counts" if name == READ_ONLY else "")
        for name, kind in store.types.items()
    ]


class Station:
    """Stand-in for an AL state machine and a system service."""

    def __init__(self) -> None:
        self.al_state = OP

    def states(self) -> AdsStates:
        return states_of(self.al_state)

    def control(self, request: WriteControl) -> None:
        self.al_state = al_state_for(request.ads_state)


def info(name: str) -> AdsDeviceInfo:
    return AdsDeviceInfo(3, 1, 4024, device_name(name))


def variable_device(store: DictStore, station: Station) -> tuple[AdsDevice, SymbolSpace]:
    """Return a device with symbols, and the space they are in."""
    space = SymbolSpace(SymbolTable(variables(store), 1), store)
    device = AdsDevice(info("island-01"), station.states, [space], control=station.control)
    return device, space


class FakeMaster:
    """A bus of three slaves that remembers what it was asked for."""

    def __init__(self) -> None:
        self.al_state = OP
        self.all: list[SlaveState] = [
            SlaveState(1001, OP, 0),
            SlaveState(1002, SAFEOP | 0x10, 0),
            SlaveState(1003, OP, 1),
        ]
        self.asked: list[tuple[int, ...]] = []

    def state(self) -> int:
        return self.al_state

    def slaves(self) -> Sequence[SlaveState]:
        return self.all

    def request_state(self, state: int) -> None:
        self.asked.append((state,))

    def request_slave_state(self, address: int, state: int) -> None:
        self.asked.append((address, state))


def master_device(master: FakeMaster, station: Station) -> AdsDevice:
    return AdsDevice(info("bus0"), station.states, [MasterSpace(master)])


def io_device(station: Station) -> AdsDevice:
    devices = [
        IoDevice(1, "eap0", IoDeviceType.EAP, NetId.parse("5.23.91.23.3.1")),
        IoDevice(2, "bus0", IoDeviceType.MASTER, BUS_NET_ID),
    ]
    return AdsDevice(info("I/O server"), station.states, [IoSpace(devices)])


def system_device(station: Station) -> AdsDevice:
    def state() -> AdsSystemState:
        return AdsSystemState(AdsState.RUN, 1, restart_index=7, version=3, revision=1, build=4024)

    return AdsDevice(info("system service"), station.states, [SystemSpace(state)])
