"""The JSON API: values, writes, status, pages, trends, sessions (docs/web-api.md)."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterable, Mapping
from pathlib import Path
from time import time
from typing import Any, Final

import msgspec
from aiohttp import web

from devicebus.errors import BusError
from eap.ams.spec import Role
from eap.config.pictures import read_picture
from eap.config.web import default_pages, window_s
from eap.config.web_sections import CommentRule, PicturePanel, SetPanel, WebPage, WebSection
from eap.control.protocol import ErrorCode, WriteOrigin
from eap.errors import ControlError
from eap.ids import encode_value
from eap.patterns import match_names
from eap.release import RELEASE
from eap.runtime.logins import Principal
from eap.web.feed import UNKNOWN, PlantFeed, ShownValue
from eap.web.guard import TOKEN, USER, Guard, is_browser, needs_user, read_json, refusal
from eap.web.openapi import DOCUMENT
from eap.web.topics import PageTopics

API = "/api/v1"
_MAX_NAMES = 2000
"""Variables of one answer."""
_MAX_COMMENT = 200
_STATUS: Final[Mapping[str, int]] = {
    ErrorCode.BAD_REQUEST: 400,
    ErrorCode.UNKNOWN_NAME: 404,
    ErrorCode.VALUE: 422,
    ErrorCode.REFUSED: 403,
    ErrorCode.BUSY: 503,
    ErrorCode.UNAVAILABLE: 503,
}
_PICTURE_POLICY = "default-src 'none'; style-src 'none'; sandbox"

encode: Callable[[Any], bytes] = msgspec.json.Encoder(enc_hook=encode_value).encode


def answer(body: Any, status: int = 200) -> web.Response:
    """Return an answer with a JSON body."""
    return web.Response(status=status, body=encode(body), content_type="application/json")


class Api:
    """Handlers of the API.

    Args:
        section: The key ``web``; without pages there are default pages.
        feed: The plant.
        topics: Has the histories of trends.
        guard: Checks logins and changes.
        end_session: Closes the WebSockets of a session.
    """

    def __init__(
        self,
        section: WebSection,
        feed: PlantFeed,
        topics: PageTopics,
        guard: Guard,
        end_session: Callable[[str], Awaitable[None]],
    ) -> None:
        self._end_session = end_session
        self._section = section
        self._feed = feed
        self._topics = topics
        self._guard = guard
        self._rules = SetRules(section.pages)
        self._pages: tuple[WebPage, ...] = section.pages
        self._pages_of: tuple[str, list[str]] | None = None
        self._pictures: dict[str, tuple[float, str]] = {}
        topics.set_pages(section.pages)

    def routes(self) -> list[web.RouteDef]:
        """Return all routes, the fixed paths first."""
        return [
            web.get("/openapi.json", self._openapi),
            web.get(f"{API}/session", self._session),
            web.post(f"{API}/login", self._login),
            web.post(f"{API}/logout", self._logout),
            web.get(f"{API}/status", self._status),
            web.get(f"{API}/plant", self._plant),
            web.get(f"{API}/pages", self._get_pages),
            web.get(f"{API}/variables", self._variables),
            web.get(f"{API}/events", self._events),
            web.get(f"{API}/routes/{{station}}/", self._routes),
            web.get(f"{API}/pictures/{{page}}/{{panel}}", self._picture),
            web.get(f"{API}/history/{{station}}/{{variable}}", self._history),
            web.get(f"{API}/{{station}}/{{variable}}", self._read),
            web.post(f"{API}/{{station}}/{{variable}}", self._write),
        ]

    def update_pages(self) -> None:
        """Make the default pages anew when the stations of the plant are known, or changed."""
        if self._section.pages:
            return
        known = self._feed.plant, self._feed.stations()
        if known != self._pages_of and known[1]:
            self._pages_of = known
            self._pages = default_pages(*known)
            self._topics.set_pages(self._pages)

    async def _openapi(self, request: web.Request) -> web.Response:
        del request
        return answer(DOCUMENT)

    async def _session(self, request: web.Request) -> web.Response:
        user = request[USER]
        return answer(
            {
                "version": 1,
                "release": RELEASE,
                "plant": self._feed.plant,
                "user": user.name if user else None,
                "role": user.role if user else None,
                "can_log_in": self._guard.has_logins,
                "csrf": self._guard.csrf(request),
            }
        )

    async def _login(self, request: web.Request) -> web.Response:
        if (refused := self._guard.refuse_change(request)) is not None:
            return refused
        body = await read_json(request)
        match body:
            case {"user": str(user), "password": str(password)}:
                found = await self._guard.login(user, password, self._guard.host_of(request))
            case _:
                raise web.HTTPBadRequest(reason='expected {"user": "…", "password": "…"}')
        if isinstance(found, web.Response):
            return found
        response = answer({"user": user, "csrf": self._guard.sessions.csrf(found)})
        self._guard.set_cookie(response, found)
        return response

    async def _logout(self, request: web.Request) -> web.Response:
        if (refused := self._guard.refuse_change(request)) is not None:
            return refused
        if token := request[TOKEN]:
            self._guard.sessions.end(token)
            # A WebSocket has shown its session only once, when it began.
            await self._end_session(token)
        response = answer({"user": None})
        self._guard.set_cookie(response, "")
        return response

    async def _status(self, request: web.Request) -> web.Response:
        needs_user(request)
        report = self._feed.report
        if report is None:
            return refusal(503, "no status yet: try again in a second")
        document = msgspec.to_builtins(report.status, enc_hook=encode_value)
        return answer(document | {"time": report.time, "unreachable": report.unreachable})

    async def _plant(self, request: web.Request) -> web.Response:
        needs_user(request)
        return answer({"time": round(time(), 3), **self._feed.overview()})

    async def _get_pages(self, request: web.Request) -> web.Response:
        needs_user(request)
        self.update_pages()
        pages = [msgspec.to_builtins(page) for page in self._pages]
        for page in pages:
            # Lines of the plant file and paths of this host are not for browsers.
            del page["at"]
            for panel in page["panels"]:
                del panel["at"]
                panel.pop("file", None)
                for bound in panel.get("bind", {}).values():
                    del bound["at"]
        return answer({"plant": self._feed.plant, "pages": pages})

    async def _variables(self, request: web.Request) -> web.Response:
        needs_user(request)
        return answer(
            {
                f"{station}/{name}": variable
                for station, directory in self._feed.directories.items()
                for name, variable in directory.variables.items()
            }
        )

    async def _events(self, request: web.Request) -> web.Response:
        needs_user(request)
        return answer({"events": self._feed.events()})

    async def _routes(self, request: web.Request) -> web.Response:
        needs_user(request)
        try:
            return answer({"routers": await self._feed.routes(request.match_info["station"])})
        except (ControlError, BusError) as exc:
            return _failure(exc)

    async def _picture(self, request: web.Request) -> web.Response:
        needs_user(request)
        try:
            page = self._pages[int(request.match_info["page"])]
            panel = page.panels[int(request.match_info["panel"])]
        except (ValueError, IndexError):
            raise web.HTTPNotFound(reason="no such panel") from None
        if not isinstance(panel, PicturePanel):
            raise web.HTTPNotFound(reason="the panel is no picture")
        try:
            svg = await asyncio.to_thread(self._read_picture, panel.file)
        except (OSError, ValueError) as exc:
            return refusal(404, f"{Path(panel.file).name}: {exc}")
        # Opened alone in a browser, too, nothing in it may run.
        headers = {"Content-Security-Policy": _PICTURE_POLICY}
        return web.Response(text=svg, content_type="image/svg+xml", headers=headers)

    def _read_picture(self, file: str) -> str:
        changed_s = Path(file).stat().st_mtime
        known_s, svg = self._pictures.get(file, (0.0, ""))
        # A picture may be edited while the page is served.
        if changed_s != known_s:
            svg = read_picture(Path(file)).svg
            self._pictures[file] = changed_s, svg
        return svg

    async def _history(self, request: web.Request) -> web.Response:
        needs_user(request)
        pattern = _name_of(request)
        try:
            since_s = time() - window_s(request.query["window"]) if "window" in request.query else 0
        except ValueError as exc:
            raise web.HTTPBadRequest(reason=f"window: {exc}") from None
        names = match_names(pattern, self._topics.histories)
        if not names:
            return refusal(404, f"no trend of a page shows {pattern!r}")
        found = {}
        for name in names:
            times, values = self._topics.histories[name].points(since_s)
            found[name] = {"unit": self._feed.unit_of(name), "times": times, "values": values}
        return answer(found)

    async def _read(self, request: web.Request) -> web.Response:
        needs_user(request)
        pattern = _name_of(request)
        names = self._feed.resolve([pattern])
        if not names:
            return refusal(404, f"no variable fits {pattern!r}")
        if len(names) > _MAX_NAMES:
            return refusal(413, f"{len(names)} variables fit {pattern!r}, at most {_MAX_NAMES}")
        by_station: dict[str, list[str]] = {}
        for name in names:
            station, _, variable = name.partition("/")
            by_station.setdefault(station, []).append(variable)
        try:
            parts = await asyncio.gather(
                *(self._read_station(*each, "*" in pattern) for each in by_station.items())
            )
        except (ControlError, BusError) as exc:
            return _failure(exc)
        values = {name: self._value(name, *each) for part in parts for name, each in part.items()}
        return answer(values if "*" in pattern else values[pattern])

    async def _read_station(
        self, station: str, variables: list[str], is_pattern: bool
    ) -> dict[str, tuple[ShownValue, int | None]]:
        """Return variables of one station; one that is silent hides no other that fits."""
        try:
            return await self._feed.read(station, variables)
        except (ControlError, BusError):
            if not is_pattern:
                raise
            return {f"{station}/{each}": (UNKNOWN, None) for each in variables}

    def _value(self, name: str, shown: ShownValue, quality: int | None) -> dict[str, Any]:
        return {
            "value": shown.value,
            "unit": self._feed.unit_of(name),
            "quality": quality,
            "age_us": shown.age_us,
            "time": None if shown.age_us is None else round(time() - shown.age_us / 1e6, 3),
            "stale": shown.is_stale,
        }

    async def _write(self, request: web.Request) -> web.Response:
        user = needs_user(request)
        if (refused := self._guard.refuse_change(request)) is not None:
            return refused
        name = _name_of(request)
        if why := self._rules.reason_denied(user, name):
            return refusal(403, why)
        body = await read_json(request)
        if not isinstance(body, dict) or "value" not in body or set(body) - {"value", "comment"}:
            raise web.HTTPBadRequest(reason='expected {"value": …}, with "comment": "…" or without')
        if body["value"] is None:
            return refusal(422, f"{name}: null is not a value")
        comment = body.get("comment", "")
        if not isinstance(comment, str) or len(comment) > _MAX_COMMENT:
            message = f"comment: expected a text of up to {_MAX_COMMENT} characters"
            raise web.HTTPBadRequest(reason=message)
        if why := self._rules.reason_refused(user, name, body["value"], comment):
            return refusal(422, why)
        station, _, variable = name.partition("/")
        host, role = self._guard.host_of(request), user.role_in_rules
        origin = WriteOrigin(user.name, host, comment, role=role)
        try:
            await self._feed.write(station, variable, body["value"], origin)
        except (ControlError, BusError) as exc:
            return _failure(exc)
        # A program may write all the time, and would leave no other event in the log.
        if is_browser(request):
            self._feed.note_write(name, body["value"], origin)
            self._topics.send_events()
        return answer({"written": name, "value": body["value"]})


def _name_of(request: web.Request) -> str:
    return f"{request.match_info['station']}/{request.match_info['variable']}"


def _failure(error: ControlError | BusError) -> web.Response:
    code = error.code if isinstance(error, ControlError) else ""
    return refusal(_STATUS.get(code, 502), str(error))


_MAX_SHOWN = 60
"""Characters of a value in a message."""


class SetRules:
    """The ``set`` panels of all pages, by variable.

    A variable with panels is set within the limits of one of those that the user's role may use;
    one without a panel by engineers only.
    """

    def __init__(self, pages: Iterable[WebPage]) -> None:
        self._panels: dict[str, list[SetPanel]] = {}
        for page in pages:
            for panel in page.panels:
                if isinstance(panel, SetPanel):
                    self._panels.setdefault(panel.of, []).append(panel)

    def reason_denied(self, user: Principal, name: str) -> str:
        """Return the reason that a user may not set a variable at all, empty if it may."""
        panels = self._panels.get(name)
        roles = [panel.role for panel in panels] if panels else [Role.ENGINEER]
        if any(map(user.may_act_as, roles)):
            return ""
        needed = min(roles, key=list(Role).index)
        return f"{name} is set by {needed}s: your role is {user.role}"

    def reason_refused(self, user: Principal, name: str, value: Any, comment: str) -> str:
        """Return the reason that a value breaks the rules of all panels, empty if it does not."""
        usable = [each for each in self._panels.get(name, ()) if user.may_act_as(each.role)]
        reasons = [_reason(panel, value, comment) for panel in usable]
        return "" if not reasons or "" in reasons else f"{name}: {reasons[0]}"


def _reason(panel: SetPanel, value: Any, comment: str) -> str:
    has_limits = panel.low is not None or panel.high is not None
    if has_limits:
        if isinstance(value, bool) or not isinstance(value, int | float):
            return f"{_shown(value)} is not a number"
        if panel.low is not None and value < panel.low:
            return f"{_shown(value)} is below the smallest value, {panel.low:g}"
        # NaN is above and below nothing.
        if panel.high is not None and not value <= panel.high:
            return f"{_shown(value)} is above the largest value, {panel.high:g}"
    if panel.comment is CommentRule.REQUIRED and not comment.strip():
        return "a comment is required"
    return ""


def _shown(value: Any) -> str:
    """Return a value, which may be as long as a request, as text for a message."""
    text = f"{value:g}" if isinstance(value, float) else repr(value)
    return text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}…"
