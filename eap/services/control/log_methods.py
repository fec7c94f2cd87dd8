"""Methods of the control protocol for log levels; a restart of services resets them to info.

Levels of services change here, those of optional processes by a file that these look at.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection
from contextlib import suppress
from typing import Any, get_args

import msgspec

from eap.control import log as records
from eap.control.protocol import ErrorCode, NoParameters
from eap.errors import ControlError
from eap.runtime.log import LevelFile
from eap.suggest import suggest

_PACKAGE = "eap"
_LOGGERS = {area: f"{_PACKAGE}.services.{area}" for area in records.AREAS} | {"net": "eap.net"}


class LogMethods:
    """Log levels of this process, and of the optional ones.

    Args:
        file: For the levels of optional processes.
        optional: Returns their names.
    """

    def __init__(self, file: LevelFile, optional: Callable[[], Collection[str]]) -> None:
        self._file = file
        self._optional = optional
        with suppress(OSError):
            file.write({})

    def table(self) -> dict[str, Callable[[dict[str, Any]], Any]]:
        """Return the methods by name."""
        return dict(
            (
                records.LOG_LEVELS.served_by(self._get),
                records.SET_LOG_LEVEL.served_by(self._set),
            )
        )

    def _get(self, wanted: NoParameters) -> records.LogLevels:
        del wanted
        known: dict[int, records.LevelName] = {
            getattr(logging, name.upper()): name for name in get_args(records.LevelName)
        }
        own = {
            area: known[logging.getLogger(logger).getEffectiveLevel()]
            for area, logger in _LOGGERS.items()
        }
        levels = self._file.read()
        others = {
            each: msgspec.convert(levels.get(each, "info"), records.LevelName)
            for each in self._optional()
        }
        return records.LogLevels(own | others)

    def _set(self, wanted: records.LogLevelParameters) -> records.LogLevels:
        others = set(self._optional())
        areas = [*_LOGGERS, *sorted(others)]
        if wanted.area not in {*areas, records.ALL}:
            hint = suggest(wanted.area, areas) or f"; known areas: {', '.join(areas)}"
            reason = f"unknown area {wanted.area!r}{hint}"
            raise ControlError(reason, code=ErrorCode.UNKNOWN_NAME)
        changed = others if wanted.area == records.ALL else others & {wanted.area}
        if changed:
            try:
                self._file.write(self._file.read() | dict.fromkeys(changed, wanted.level))
            except OSError as exc:
                reason = f"the levels cannot be kept: {exc.strerror}"
                raise ControlError(reason, code=ErrorCode.UNAVAILABLE) from None
        level = wanted.level.upper()
        if wanted.area == records.ALL:
            logging.getLogger(_PACKAGE).setLevel(level)
            for logger in _LOGGERS.values():  # those of their own would stay
                logging.getLogger(logger).setLevel(logging.NOTSET)
        elif wanted.area in _LOGGERS:
            logging.getLogger(_LOGGERS[wanted.area]).setLevel(level)
        return self._get(NoParameters())
