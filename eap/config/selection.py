"""Variables that patterns in a plant file select: ``STATION/NAME``, with ``*`` for any text."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from eap.codec.datatypes import variable_of
from eap.config.finding import FindingReport, one_beside, one_of
from eap.config.index import Index
from eap.config.structs import StationSection
from eap.patterns import match_names
from eap.pd.rules import MADE_SUFFIXES
from eap.suggest import suggest

_OF = "STATION/VARIABLE, with * for any text"


class VariableNames:
    """All variables of a plant file, for the checks of keys that name some.

    Attributes:
        known: Variables of each station, also those that control its frames and PDs.
        names: All of them, ``STATION/NAME``.
    """

    def __init__(self, index: Index, report: FindingReport) -> None:
        self._index = index
        self._report = report
        self.known = {
            station.name: list(_names_of(index, station)) for station in index.plant.stations
        }
        self.names = [f"{name}/{each}" for name, own in self.known.items() for each in own]

    def check_pattern(self, path: str, name: str, more: Sequence[str] = ()) -> None:
        """Report a name that is unknown, and a pattern that no variable fits, nor one of *more*."""
        if "*" not in name and name not in more:
            self.find(path, name)
        elif not match_names(name, [*self.names, *more]) and not self.may_be_on_bus(name):
            self._report.add(path, f"no variable fits {name!r}", _OF)

    def find(self, path: str, name: str) -> tuple[StationSection, str] | None:
        """Return station and variable that *name* is, after reporting that there is none."""
        station_name, separator, variable = name.partition("/")
        station = self._index.stations.get(station_name)
        if not separator:
            self._report.add(path, f"{name!r} names no variable", "STATION/VARIABLE")
        elif station is None:
            if station_name not in self._report.broken:
                message = f"unknown station {station_name!r}{suggest(station_name, self.known)}"
                self._report.add(path, message, one_of(self.known))
        elif not self._has(station, variable):
            known = self.known[station_name]
            message = f"station {station_name} has no variable {variable!r}"
            message += suggest(variable, known)
            self._report.add(path, message, one_beside(variable, known))
        else:
            return station, variable
        return None

    def _has(self, station: StationSection, variable: str) -> bool:
        if variable in self.known[station.name] or self.may_be_on_bus(f"{station.name}/{variable}"):
            return True
        try:
            return self._index.part(station, variable) is not None
        except ValueError:
            return variable.partition(".")[0].partition("[")[0] in self._report.broken

    def may_be_on_bus(self, name: str) -> bool:
        """Return whether *name* is of a bus whose file could not be read."""
        station_name, _, variable = name.partition("/")
        station = self._index.stations.get(station_name)
        if station is None:
            return False
        return any(variable.startswith(f"{p}.") for p in self._index.unread_buses(station))


def _names_of(index: Index, station: StationSection) -> Iterator[str]:
    """Yield all variables of a station, also those that control its frames and PDs."""
    yield from index.names(station)
    for frame in station.frames:
        yield f"{frame.name}{MADE_SUFFIXES[1]}"
    for pd in station.publish:
        yield f"{pd.name}{MADE_SUFFIXES[0]}"


def reason_not_settable(index: Index, station: StationSection, name: str) -> str:
    """Return why the application does not write a variable of *station*, empty if it does."""
    names = index.names(station)
    variable = variable_of(name, names)
    if any(variable_of(each, names) == variable for each in station.sources):
        return "it has a source"
    if any(variable_of(each.target, names) == variable for each in station.links):
        return "a link writes it"
    if (on_bus := index.bus_variables(station).get(variable)) is not None:
        return "" if on_bus.is_output else "it is an input of a bus"
    if variable in index.field_variables(station):
        return "it is the state of a controller"
    is_received = variable in names and variable not in station.variables
    return "it is received" if is_received else ""


def paths_of(of: str | tuple[str, ...], at: str) -> Iterator[tuple[str, str]]:
    """Yield each name of a key that has one or a list, behind its path in the file."""
    if isinstance(of, str):
        yield at, of
    else:
        yield from ((f"{at}[{position}]", name) for position, name in enumerate(of))
