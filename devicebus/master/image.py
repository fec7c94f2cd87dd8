"""Outputs and inputs of all slaves as two blocks of octets, and their values by name."""

from __future__ import annotations

from devicebus.errors import BusError
from devicebus.master.layout import Layout, Variable
from eap.codec import datatypes
from eap.codec.values import DataType, Value

_NAMES = (
    "BOOL", "SINT", "INT", "DINT", "USINT", "UINT", "UDINT", "REAL", "LREAL", "INT24", "LINT",
    "UINT24", "ULINT", "BYTE", "WORD", "DWORD", *(f"BIT{bits}" for bits in range(1, 9)),
)  # fmt: skip
_KINDS = {kind.code: kind for kind in map(datatypes.parse, _NAMES)}
_UNTYPED = {8: "USINT", 16: "UINT", 32: "UDINT", 64: "ULINT"}


class BusImage:
    """Process data of a bus.

    Attributes:
        outputs: What goes out with the next cycle.
        inputs: What came with the last one; a slave that is away keeps its last inputs.
    """

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self.outputs = bytearray(layout.outputs_size)
        self.inputs = bytearray(layout.inputs_size)
        self._variables = {(each.station, each.name): each for each in layout.variables}

    def variable(self, station: int, name: str) -> Variable:
        """Return an entry by its slave and name; raise BusError naming those that exist."""
        try:
            return self._variables[station, name]
        except KeyError:
            known = ", ".join(each for at, each in self._variables if at == station)
            raise BusError(
                f"slave {station} has no process data {name!r}, it has {known or 'none'}"
            ) from None

    def read(self, station: int, name: str) -> Value:
        """Return a value; raise BusError if there is no such entry."""
        variable = self.variable(station, name)
        octets = self.read_octets(variable)
        kind = kind_of(variable)
        return kind.decode(octets, 0) if kind else octets

    def write(self, station: int, name: str, value: Value) -> None:
        """Set an output.

        Raises:
            BusError: there is no such entry, or it is an input.
            ValueError: the value is none of its type.
        """
        variable = self.variable(station, name)
        if not variable.is_output:
            raise BusError(f"slave {station}: {name!r} is an input, expected an output")
        kind = kind_of(variable)
        if kind is None and not isinstance(value, bytes):
            raise ValueError(f"{value!r} for {name!r}, expected octets")
        self.write_octets(variable, kind.encode(value) if kind else bytes(value))  # type: ignore[arg-type]

    def read_octets(self, variable: Variable) -> bytes:
        """Return the bits of an entry, from bit 0 of the first octet on."""
        block = self.outputs if variable.is_output else self.inputs
        first, shift = divmod(variable.bit_offset, 8)
        bits = variable.bit_length
        end = first + (shift + bits + 7) // 8
        word = int.from_bytes(block[first:end], "little") >> shift & (1 << bits) - 1
        return word.to_bytes((bits + 7) // 8, "little")

    def write_octets(self, variable: Variable, octets: bytes) -> None:
        """Set the bits of an output; what lies beside them stays."""
        first, shift = divmod(variable.bit_offset, 8)
        mask = (1 << variable.bit_length) - 1
        end = first + (shift + variable.bit_length + 7) // 8
        word = int.from_bytes(self.outputs[first:end], "little") & ~(mask << shift)
        word |= (int.from_bytes(octets, "little") & mask) << shift
        self.outputs[first:end] = word.to_bytes(end - first, "little")


def kind_of(variable: Variable) -> DataType | None:
    """Return the data type of an entry; one that nobody told is a number of that many bits."""
    kind = _KINDS.get(variable.data_type)
    if kind is not None and kind.bit_length == variable.bit_length:
        return kind
    bits = variable.bit_length
    name = "BOOL" if bits == 1 else f"BIT{bits}" if 0 < bits < 8 else _UNTYPED.get(bits)
    return datatypes.parse(name) if name else None
