"""Sources in controllers of other protocols: their values, time-outs and substitutes.

A bridge passes values on as it reads them.  Time-outs are decided here, beside the process image,
so that a bridge that hangs, dies or was never started is the same to consumers as a controller that
does not answer: after the time-out a variable has its substitute, and ``CONTROLLER.ok`` is false.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from eap.codec import datatypes
from eap.codec.basetypes import DataType
from eap.codec.datatypes import find_variable, with_nan
from eap.codec.structures import complete
from eap.pd.spec import FieldSource, StationSpec, Substitute, VariableSpec

OK, AGE = ".ok", ".age_ms"
"""Suffixes of the variables that each controller has in a station that reads it."""
NEVER_MS = 0xFFFF_FFFF
"""Age of a controller that was never read."""


def controller_variables(controllers: Iterable[str]) -> dict[str, tuple[str, str, str]]:
    """Return type, unit and comment of the variables of *controllers*, by their names."""
    found = {}
    for name in dict.fromkeys(controllers):
        found[f"{name}{OK}"] = "BOOL", "", f"all values of {name} are newer than their time-outs"
        found[f"{name}{AGE}"] = "UDINT", "ms", f"age of the oldest value of {name}"
    return found


class _Filled:
    """State of one source; *is_late* once its substitute applies."""

    def __init__(self, source: FieldSource, kind: DataType, default: Any) -> None:
        self.source = source
        self.controller = source.controller
        self.kind = kind
        self.timeout_ns = source.timeout_ms * 1_000_000
        self.substitute = source.substitute or Substitute.HOLD
        self.default = default
        self.at_ns: int | None = None
        self.is_late = True

    def age_ns(self, now_ns: int) -> int | None:
        """Return the age of the value, None before the first."""
        return None if self.at_ns is None else max(now_ns - self.at_ns, 0)


class FieldSources:
    """The sources of one station that bridges fill.

    Args:
        station: The station.
        before: Those of an earlier specification, whose ages go on where a source is the same.
    """

    def __init__(self, station: StationSpec, before: FieldSources | None = None) -> None:
        variables = {each.name: each for each in station.variables}
        self._filled: dict[str, _Filled] = {}
        for source in station.sources:
            if isinstance(source, FieldSource):
                kind, default = _kind_and_default(variables, source.variable)
                filled = self._filled[source.variable] = _Filled(source, kind, default)
                known = before and before.find(source.variable)
                if known and (known.source, known.kind) == (source, kind):
                    filled.at_ns, filled.is_late = known.at_ns, known.is_late
        self._by_controller: dict[str, list[_Filled]] = {}
        for each in self._filled.values():
            self._by_controller.setdefault(each.controller, []).append(each)

    def find(self, variable: str) -> _Filled | None:
        """Return the state of the source of *variable*."""
        return self._filled.get(variable)

    def __bool__(self) -> bool:
        return bool(self._filled)

    def unknown(self, names: Iterable[str]) -> list[str]:
        """Return those of *names* that no bridge fills."""
        return [name for name in names if name not in self._filled]

    def fill(self, plain: Mapping[str, Any], now_ns: int) -> dict[str, Any]:
        """Take values that a bridge has just read; return what is to be written.

        Args:
            plain: Values in the form of JSON, of known sources.
            now_ns: Monotonic time.

        Raises:
            ValueError: one is not a value of its variable; nothing was taken.
        """
        values = {}
        for name, value in plain.items():
            try:
                values[name] = self._filled[name].kind.from_plain(with_nan(value))
            except ValueError as exc:
                raise ValueError(f"{name}: {exc}") from None
        for name in values:
            filled = self._filled[name]
            filled.at_ns, filled.is_late = now_ns, False
        controllers = {self._filled[name].controller for name in values}
        return values | self._states(controllers, now_ns)

    def check(self, now_ns: int) -> dict[str, Any]:
        """Return what is to be written now: substitutes, and the states of controllers."""
        values: dict[str, Any] = {}
        for name, filled in self._filled.items():
            age_ns = filled.age_ns(now_ns)
            if filled.is_late or (age_ns is not None and age_ns <= filled.timeout_ns):
                continue
            filled.is_late = True
            if filled.substitute is Substitute.ZERO:
                values[name] = filled.kind.zero
            elif filled.substitute is Substitute.DEFAULT:
                values[name] = filled.default
        return values | self._states(self._by_controller, now_ns)

    def resume(self, moments: Mapping[str, int]) -> None:
        """Continue with the times of the newest values that an earlier process took."""
        for name, filled in self._filled.items():
            if at_ns := moments.get(name, 0):
                filled.at_ns, filled.is_late = at_ns, False

    def moments(self) -> dict[str, int]:
        """Return the time of each source's newest value, 0 before the first."""
        return {name: filled.at_ns or 0 for name, filled in self._filled.items()}

    def _states(self, controllers: Iterable[str], now_ns: int) -> dict[str, Any]:
        states: dict[str, Any] = {}
        for name in controllers:
            own = self._by_controller[name]
            states[f"{name}{OK}"] = not any(each.is_late for each in own)
            states[f"{name}{AGE}"] = _age_ms(own, now_ns)
        return states


def _age_ms(own: Iterable[_Filled], now_ns: int) -> int:
    oldest = 0
    for each in own:
        age_ns = each.age_ns(now_ns)
        if age_ns is None:
            return NEVER_MS
        oldest = max(oldest, age_ns)
    return min(oldest // 1_000_000, NEVER_MS - 1)


def _kind_and_default(variables: Mapping[str, VariableSpec], name: str) -> tuple[DataType, Any]:
    """Return type and default of a variable or a part of one."""

    def type_of(variable: str) -> DataType | None:
        spec = variables.get(variable)
        return None if spec is None else datatypes.parse(spec.type)

    found = find_variable(name, type_of)
    if found is None:  # the checks of the configuration have found it
        raise LookupError(name)
    variable, (kind, bit_offset) = found
    spec = variables[variable]
    whole = datatypes.parse(spec.type)
    if spec.default is None:
        return kind, kind.zero
    octets = whole.encode(whole.from_plain(complete(whole, spec.default)))
    at, bit = divmod(bit_offset, 8)
    if kind.is_bits:
        return kind, kind.decode(bytes((octets[at] >> bit & (1 << kind.bit_length) - 1,)), 0)
    return kind, kind.decode(octets, at)
