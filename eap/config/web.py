"""The key ``web`` of a plant file: checks, default pages, and the record that the server gets."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from ipaddress import ip_network
from pathlib import Path
from typing import TypeVar

from msgspec.structs import replace

from eap.ams.spec import Role
from eap.codec import datatypes
from eap.config.files import check_file, whole_path
from eap.config.finding import FindingReport, PlantFinding, one_of
from eap.config.index import Index
from eap.config.listen import parse_listen
from eap.config.pictures import read_picture
from eap.config.selection import VariableNames, paths_of, reason_not_settable
from eap.config.structs import StationSection
from eap.config.users import check_users
from eap.config.web_sections import (
    BindSection,
    BusPanel,
    EventsPanel,
    GraphPanel,
    MetricsSection,
    Panel,
    PicturePanel,
    RoutesPanel,
    ServerSection,
    SetPanel,
    StatesPanel,
    TablePanel,
    TrendPanel,
    ValuePanel,
    WebPage,
    WebSection,
)
from eap.ids import parse_host
from eap.patterns import match_names
from eap.pd.spec import PortKind
from eap.suggest import suggest

MAX_WINDOW_S = 24 * 3600
MIN_WINDOW_S = 10
MAX_TRENDS = 200
"""Variables of all trends: the server keeps the last window of each."""
MAX_PANELS = 200
"""Panels of a page."""
STATE = "state"
"""State of a station as if it were one of its variables, unless it has one with this name."""

ServerT = TypeVar("ServerT", WebSection, MetricsSection)

_LISTEN = "ADDRESS:PORT, such as 127.0.0.1:8080 or [::1]:8080"
_WINDOW = re.compile(r"(\d{1,6})(s|m|h)")
_UNITS = {"s": 1, "m": 60, "h": 3600}
_HEADER = re.compile(r"[A-Za-z0-9-]+")


def window_s(text: str) -> int:
    """Return the seconds of a window such as ``10m``; raise ValueError if it is none."""
    match = _WINDOW.fullmatch(text)
    if match is None:
        raise ValueError(f"{text!r} is not a time")
    seconds = int(match[1]) * _UNITS[match[2]]
    if not MIN_WINDOW_S <= seconds <= MAX_WINDOW_S:
        raise ValueError(f"{text!r} is out of range")
    return seconds


def names_in(of: str | tuple[str, ...]) -> tuple[str, ...]:
    """Return the names and patterns of a panel's ``of``."""
    return (of,) if isinstance(of, str) else of


def trend_windows(pages: Iterable[WebPage]) -> dict[str, int]:
    """Return the longest window of each pattern of the trends of *pages*, in seconds."""
    found: dict[str, int] = {}
    for page in pages:
        for panel in page.panels:
            if isinstance(panel, TrendPanel):
                for name in names_in(panel.of):
                    found[name] = max(found.get(name, 0), window_s(panel.window))
    return found


def default_pages(plant: str, stations: Iterable[str]) -> tuple[WebPage, ...]:
    """Return pages for a plant without ``pages``: one of the plant, and one a station."""
    overview = WebPage(
        name=plant or "plant",
        panels=(GraphPanel(), BusPanel(), EventsPanel()),
    )
    own = (
        WebPage(
            name=name,
            panels=(
                GraphPanel(of=name),
                TablePanel(of=f"{name}/*"),
                BusPanel(of=f"{name}/*"),
                RoutesPanel(of=name),
                EventsPanel(of=name),
            ),
        )
        for name in stations
    )
    return overview, *own


def resolved_tls(section: ServerT, folder: Path) -> ServerT:
    """Return *section* with the paths of certificate and key from *folder* on."""
    tls = section.tls and replace(
        section.tls,
        certificate=whole_path(folder, section.tls.certificate),
        key=whole_path(folder, section.tls.key),
    )
    return replace(section, tls=tls)


def resolved(web: WebSection, folder: Path) -> WebSection:
    """Return *web*, which has no findings, with the paths of its files from *folder* on."""

    def panel(each: Panel) -> Panel:
        if isinstance(each, PicturePanel):
            return replace(each, file=whole_path(folder, each.file))
        return each

    pages = tuple(replace(page, panels=tuple(map(panel, page.panels))) for page in web.pages)
    return resolved_tls(replace(web, pages=pages), folder)


def check_web(index: Index, report: FindingReport, folder: Path) -> None:
    """Report every invalid key of ``web`` and ``metrics``; files are in *folder*."""
    web, metrics = index.plant.web, index.plant.metrics
    if metrics is not None:
        _check_server(metrics, index, report, folder)
    if web is None:
        return
    _check_server(web, index, report, folder)
    names: dict[str, WebPage] = {}
    for page in web.pages:
        if not page.name.strip():
            report.add(f"{page.at}.name", "the page has an empty name", "a text")
        elif names.setdefault(page.name, page) is not page:
            report.add(f"{page.at}.name", f"page {page.name!r} is there twice", "each name once")
        if len(page.panels) > MAX_PANELS:
            message = f"page {page.name!r} has {len(page.panels)} panels"
            report.add(f"{page.at}.panels", message, f"at most {MAX_PANELS}")
    _PanelCheck(index, report, folder).check(web)


def warn_of_pictures(index: Index, report: FindingReport, folder: Path) -> list[PlantFinding]:
    """Return a warning for each picture with elements that the page leaves out."""
    web = index.plant.web
    found = []
    for page in web.pages if web else ():
        for panel in page.panels:
            if not isinstance(panel, PicturePanel):
                continue
            if left_out := read_picture(folder / panel.file).left_out:
                message = f"{panel.file}: the page leaves out {', '.join(left_out)}"
                expected = "shapes and texts whose looks are attributes"
                line = report.line_of(f"{panel.at}.file")
                found.append(PlantFinding(report.file, line, panel.at, message, expected))
    return found


def _check_server(
    section: ServerSection, index: Index, report: FindingReport, folder: Path
) -> None:
    """Report every invalid key that all servers have."""
    _check_listen(section, report)
    shared = index.plant.users
    check_users(section.users, report, needs_passwords=section.proxy is None, shared=shared)
    _check_proxy(section, report)
    for position, name in enumerate(section.hosts):
        try:
            parse_host(name.replace(":", " "), 80)
        except ValueError:
            at = f"{section.at}.hosts[{position}]"
            report.add(at, f"{name!r} is no name of a host", "a name")
    if section.tls is not None:
        check_file(f"{section.tls.at}.certificate", section.tls.certificate, report, folder)
        check_file(f"{section.tls.at}.key", section.tls.key, report, folder)


def _check_listen(web: ServerSection, report: FindingReport) -> None:
    at = f"{web.at}.listen"
    try:
        listen = parse_listen(web.listen)
    except ValueError as exc:
        report.add(at, f"listen: {exc}", _LISTEN)
        return
    if listen.is_loopback:
        return
    # Without these the plant would be open to the network, and passwords would go in clear.
    if not web.users and web.proxy is None:
        message = f"listen: {web.listen} is reached by other hosts, and there are no users"
        report.add(at, message, "users, or an address of this host alone (127.0.0.1)")
    if web.tls is None:
        message = f"listen: {web.listen} is reached by other hosts, and there is no tls"
        report.add(at, message, "tls with certificate and key, or 127.0.0.1")
    if web.anonymous not in {None, Role.VIEWER}:
        message = f"anonymous: every host would be {web.anonymous} without a password"
        report.add(f"{web.at}.anonymous", message, "viewer, or no such key")


def _check_proxy(web: ServerSection, report: FindingReport) -> None:
    if (proxy := web.proxy) is None:
        return
    if not _HEADER.fullmatch(proxy.header):
        message = f"header {proxy.header!r} is no name of a header"
        report.add(f"{proxy.at}.header", message, "a name such as X-Remote-User")
    if not proxy.networks:
        report.add(f"{proxy.at}.from", "from is empty", "the address of the proxy")
    for position, text in enumerate(proxy.networks):
        at = f"{proxy.at}.from[{position}]"
        try:
            network = ip_network(text, strict=False)
        except ValueError:
            message = f"{text!r} is no address and no network"
            report.add(at, message, "the address of the proxy")
            continue
        if not network.prefixlen:
            message = f"{text}: every host could name itself any user"
            report.add(at, message, "the address of the proxy")
    if not web.users:
        report.add(proxy.at, "a proxy without users", "users with their roles, without passwords")


class _PanelCheck:
    """Check of the panels of all pages against the names of the plant."""

    def __init__(self, index: Index, report: FindingReport, folder: Path) -> None:
        self._index = index
        self._report = report
        self._folder = folder
        self._variables = VariableNames(index, report)

    def check(self, web: WebSection) -> None:
        """Report every invalid panel."""
        trends: set[str] = set()
        for page in web.pages:
            for panel in page.panels:
                self._check_panel(panel)
                if isinstance(panel, TrendPanel):
                    names = self._variables.names
                    trends.update(*(match_names(of, names) for of in names_in(panel.of)))
        if len(trends) > MAX_TRENDS:
            message = f"the trends show {len(trends)} variables"
            self._report.add(f"{web.at}.pages", message, f"at most {MAX_TRENDS}")

    def _check_panel(self, panel: Panel) -> None:
        match panel:
            case ValuePanel() | TablePanel():
                self._check_variables(panel)
            case StatesPanel():
                self._check_variables(panel, [f"{name}/{STATE}" for name in self._variables.known])
            case TrendPanel():
                self._check_variables(panel)
                self._check_range(panel)
                self._check_window(panel)
            case SetPanel():
                self._check_set(panel)
            case PicturePanel():
                self._check_picture(panel)
            case BusPanel():
                self._check_patterns(panel, "bus", self._buses(), "STATION/PORT")
            case EventsPanel() | GraphPanel() | RoutesPanel():
                self._check_patterns(panel, "station", self._variables.known, "a station")

    def _check_variables(
        self,
        panel: ValuePanel | TablePanel | StatesPanel | TrendPanel,
        more: Sequence[str] = (),
    ) -> None:
        for path, name in paths_of(panel.of, f"{panel.at}.of"):
            self._variables.check_pattern(path, name, more)

    def _check_patterns(
        self,
        panel: BusPanel | EventsPanel | GraphPanel | RoutesPanel,
        noun: str,
        known: Iterable[str],
        expected: str,
    ) -> None:
        names = list(known)
        is_default = panel.of in {"*", "*/*"}
        for path, name in paths_of(panel.of, f"{panel.at}.of"):
            if not is_default and not match_names(name, names):
                hint = "" if "*" in name else suggest(name, names)
                message = f"unknown {noun} {name!r}{hint}"
                self._report.add(path, message, one_of(names) if names else expected)

    def _buses(self) -> list[str]:
        return [
            f"{station.name}/{port.name}"
            for station in self._index.plant.stations
            for port in station.ports
            if port.kind is PortKind.BUS
        ]

    def _check_window(self, panel: TrendPanel) -> None:
        try:
            window_s(panel.window)
        except ValueError as exc:
            expected = "a time from 10s to 24h, such as 10m"
            self._report.add(f"{panel.at}.window", f"window: {exc}", expected)

    def _check_range(self, panel: TrendPanel | SetPanel | BindSection) -> None:
        if panel.low is not None and panel.high is not None and panel.low >= panel.high:
            message = f"min {panel.low:g} is not below max {panel.high:g}"
            self._report.add(f"{panel.at}.min", message, "a smaller one")

    def _check_set(self, panel: SetPanel) -> None:
        self._check_range(panel)
        if panel.role is Role.VIEWER:
            self._report.add(f"{panel.at}.for", "viewers set nothing", "operator or engineer")
        if panel.step is not None and panel.step <= 0:
            self._report.add(f"{panel.at}.step", f"step is {panel.step:g}", "more than 0")
        path = f"{panel.at}.of"
        if (found := self._variables.find(path, panel.of)) is None:
            return
        station, variable = found
        if reason := reason_not_settable(self._index, station, variable):
            message = f"variable {panel.of} cannot be set: {reason}"
            self._report.add(path, message, "a variable without source and link")
        has_limits = panel.low is not None or panel.high is not None
        if has_limits and not _is_number(self._index, station, variable):
            key = "min" if panel.low is not None else "max"
            message = f"variable {panel.of} is no number"
            self._report.add(f"{panel.at}.{key}", message, "no limits")

    def _check_picture(self, panel: PicturePanel) -> None:
        try:
            ids = read_picture(self._folder / panel.file).ids
        except ValueError as exc:
            expected = "an SVG picture, its path from the plant file on"
            self._report.add(f"{panel.at}.file", f"{panel.file}: {exc}", expected)
            ids = None
        for selector, bound in panel.bind.items():
            path = f"{panel.at}.bind.{selector}"
            self._variables.find(path, bound.of)
            self._check_range(bound)
            if not selector.startswith("#"):
                self._report.add(path, f"{selector!r} is no element", "# and the id of an element")
            elif ids is not None and selector[1:] not in ids:
                message = f"{panel.file} has no element {selector!r}{suggest(selector[1:], ids)}"
                self._report.add(path, message, one_of(sorted(ids)[:12]))


def _is_number(index: Index, station: StationSection, name: str) -> bool:
    try:
        part = index.part(station, name)
    except ValueError:
        return True  # a finding of its own
    if part is None:
        return True
    kind = part.kind
    return isinstance(kind, datatypes.Integer | datatypes.Real)
