"""Sections of the key ``web`` of a plant file: the page for browsers; docs/web.md explains them.

The process that serves the page gets these records as they are, with resolved paths, and browsers
get those of panels as JSON.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, ClassVar, TypeAlias

import msgspec
from msgspec import Meta

from eap.ams.spec import Role
from eap.config.structs import Section
from eap.config.users import AccountSection


class CommentRule(StrEnum):
    """Comment on a value that a ``set`` panel sets."""

    NONE = "none"
    OPTIONAL = "optional"
    REQUIRED = "required"


class EventLevel(StrEnum):
    """Severity of events."""

    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


class Show(StrEnum):
    """Effect of a variable on an element of a picture."""

    AUTO = "auto"
    """Text for text elements, else colour: by limits, or on and off."""
    TEXT = "text"
    COLOR = "color"
    VISIBLE = "visible"
    LEVEL = "level"
    """Height of the element, from 0 at *min* to its own at *max*."""
    TURN = "turn"
    """Rotation in degrees about the element's centre."""


class PanelSection(Section, frozen=True, kw_only=True, tag_field="kind"):
    """Base of the panels of a page."""

    title: str = ""


class ValuePanel(PanelSection, frozen=True, kw_only=True, tag="value"):
    """Present values, each in large digits."""

    of: str | tuple[str, ...]
    unit: str = ""
    decimals: Annotated[int, Meta(ge=0, le=9)] | None = None
    warn: float | None = None
    alarm: float | None = None
    warn_below: float | None = None
    alarm_below: float | None = None


class TrendPanel(PanelSection, frozen=True, kw_only=True, tag="trend"):
    """Curves of the last *window*."""

    of: str | tuple[str, ...]
    window: str = "10m"
    unit: str = ""
    low: float | None = msgspec.field(name="min", default=None)
    high: float | None = msgspec.field(name="max", default=None)


class StatesPanel(PanelSection, frozen=True, kw_only=True, tag="states"):
    """States as coloured fields: of stations (``STATION/state``) and of variables."""

    of: str | tuple[str, ...] = "*/state"


class SetPanel(PanelSection, frozen=True, kw_only=True, tag="set"):
    """Input field, switch or choice for one variable of the application."""

    of: str
    unit: str = ""
    low: float | None = msgspec.field(name="min", default=None)
    high: float | None = msgspec.field(name="max", default=None)
    step: float | None = None
    role: Role = msgspec.field(name="for", default=Role.OPERATOR)
    comment: CommentRule = CommentRule.NONE


class BindSection(Section, frozen=True, kw_only=True):
    """Variable that changes an element of a picture."""

    of: str
    show: Show = Show.AUTO
    low: float = msgspec.field(name="min", default=0.0)
    high: float = msgspec.field(name="max", default=100.0)
    warn: float | None = None
    alarm: float | None = None

    SHORT: ClassVar[str] = "of"


class PicturePanel(PanelSection, frozen=True, kw_only=True, tag="picture"):
    """SVG picture with elements that variables change; *bind* is by ``#ID`` of the element."""

    file: str
    bind: dict[str, BindSection] = msgspec.field(default_factory=dict)


class EventsPanel(PanelSection, frozen=True, kw_only=True, tag="events"):
    """Latest events, in words."""

    level: EventLevel = msgspec.field(name="from", default=EventLevel.INFO)
    of: str | tuple[str, ...] = "*"
    rows: Annotated[int, Meta(ge=1, le=500)] = 20


class BusPanel(PanelSection, frozen=True, kw_only=True, tag="bus"):
    """Slaves of buses (``STATION/PORT``) with their states and faults."""

    of: str | tuple[str, ...] = "*/*"


class GraphPanel(PanelSection, frozen=True, kw_only=True, tag="plant"):
    """The plant as a graph: stations, and the process data between them."""

    of: str | tuple[str, ...] = "*"


class TablePanel(PanelSection, frozen=True, kw_only=True, tag="variables"):
    """Table of variables with value, unit and age."""

    of: str | tuple[str, ...] = "*/*"


class RoutesPanel(PanelSection, frozen=True, kw_only=True, tag="routes"):
    """AMS routes of stations."""

    of: str | tuple[str, ...] = "*"


Panel: TypeAlias = (
    ValuePanel
    | TrendPanel
    | StatesPanel
    | SetPanel
    | PicturePanel
    | EventsPanel
    | BusPanel
    | GraphPanel
    | TablePanel
    | RoutesPanel
)


class WebPage(Section, frozen=True, kw_only=True):
    """Page with its panels, in reading order."""

    name: str
    panels: tuple[Panel, ...]


class WebTls(Section, frozen=True, kw_only=True):
    """Certificate and key of the page's server; files by their paths from the plant file on."""

    certificate: str
    key: str


class WebProxy(Section, frozen=True, kw_only=True):
    """Reverse proxy that authenticates users and names them in *header*."""

    header: str
    networks: tuple[str, ...] = msgspec.field(name="from", default=("127.0.0.1",))


class ServerSection(Section, frozen=True, kw_only=True):
    """Server by HTTP: its address, users and certificate."""

    listen: str
    hosts: tuple[str, ...] = ()
    users: tuple[AccountSection, ...] = ()
    anonymous: Role | None = None
    tls: WebTls | None = None
    proxy: WebProxy | None = None

    SHORT: ClassVar[str] = "listen"
    KEY: ClassVar[str]
    """Key of the plant file that it is."""


class WebSection(ServerSection, frozen=True, kw_only=True):
    """Page for browsers, its JSON API, and metrics."""

    listen: str = "127.0.0.1:8080"
    pages: tuple[WebPage, ...] = ()

    KEY: ClassVar[str] = "web"


class MetricsSection(ServerSection, frozen=True, kw_only=True):
    """Metrics alone."""

    listen: str = "127.0.0.1:9464"

    KEY: ClassVar[str] = "metrics"
