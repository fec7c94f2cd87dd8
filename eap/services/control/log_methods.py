"""Methods of the control protocol for log levels; a restart of services resets them to info."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, get_args

from eap.control import log as records
from eap.control.protocol import ErrorCode, NoParameters
from eap.errors import ControlError
from eap.suggest import suggest

_PACKAGE = "eap"
_LOGGERS = {area: f"{_PACKAGE}.services.{area}" for area in records.AREAS} | {"net": "eap.net"}


class LogMethods:
    """Log levels of this process."""

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
        return records.LogLevels(
            {
                area: known[logging.getLogger(logger).getEffectiveLevel()]
                for area, logger in _LOGGERS.items()
            }
        )

    def _set(self, wanted: records.LogLevelParameters) -> records.LogLevels:
        if wanted.area not in {*_LOGGERS, records.ALL}:
            hint = suggest(wanted.area, _LOGGERS) or f"; known areas: {', '.join(_LOGGERS)}"
            reason = f"unknown area {wanted.area!r}{hint}"
            raise ControlError(reason, code=ErrorCode.UNKNOWN_NAME)
        level = wanted.level.upper()
        if wanted.area == records.ALL:
            logging.getLogger(_PACKAGE).setLevel(level)
            for logger in _LOGGERS.values():  # those of their own would stay
                logging.getLogger(logger).setLevel(logging.NOTSET)
        else:
            logging.getLogger(_LOGGERS[wanted.area]).setLevel(level)
        return self._get(NoParameters())
