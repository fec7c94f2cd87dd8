"""Control protocol: log levels of services, by area."""

from __future__ import annotations

from typing import Literal, TypeAlias

from eap.control.protocol import Document, Method, NoParameters, Parameters

LevelName: TypeAlias = Literal["debug", "info", "warning", "error"]
ALL = "all"
AREAS = ("ads", "control", "device", "gateway", "net", "routing", "slaves", "transports")
"""Packages of services that log, and the drivers of sockets (``net``).

Optional processes are areas by their own names.
"""


class LogLevelParameters(Parameters, frozen=True, kw_only=True):
    """``set_log_level``: lines below *level* are left out, in one *area* or in all."""

    level: LevelName
    area: str = ALL


class LogLevels(Document, frozen=True):
    """Answer to both methods: the level of each area."""

    levels: dict[str, LevelName]


LOG_LEVELS = Method("log_levels", NoParameters, LogLevels)
SET_LOG_LEVEL = Method("set_log_level", LogLevelParameters, LogLevels)
