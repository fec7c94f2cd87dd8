"""Decisions on each request before it is answered: host, rate, user, origin.

A page of another site may send requests from a browser of this network.  The rules against that:
the Host header is an address or a known name (DNS rebinding), a request with an Origin has that of
this server, and a change that comes from a browser carries the token that only this server's own
pages can read.  No answer allows another origin to read it.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import json
import logging
import os
import re
from base64 import b64decode
from collections import OrderedDict
from collections.abc import Awaitable, Callable
from ipaddress import ip_address, ip_network
from secrets import token_hex
from time import monotonic, time
from typing import Final, TypeAlias

import msgspec
from aiohttp import web

from eap.config.listen import role_of_anonymous
from eap.config.web_sections import ServerSection
from eap.control.logins import NOTE_LOGINS
from eap.live.view import LiveView
from eap.net.limits import RateLimiter
from eap.runtime.logins import LoginFailure, LoginRefusals, Logins, Principal
from eap.web.sessions import SESSION_S, Sessions

Handler: TypeAlias = Callable[[web.Request], Awaitable[web.StreamResponse]]

COOKIE = "eap-session"
CSRF_HEADER = "X-CSRF-Token"
MAX_BODY = 64 << 10
BODY_S = 10.0
"""Time for the body of a request."""
_RATE = 200, 50.0
"""Requests of a host at once, and each second in the long run."""
_FILE_RATE = 3000, 600.0
"""The same of files of the page: a browser that opens some tabs asks for hundreds, and a file that
does not come leaves an empty page."""
_MAX_HOSTS = 1024
_REMEMBERED_S = 300.0
_MAX_REMEMBERED = 256
_SAFE = frozenset(("GET", "HEAD"))
_NAME = re.compile(r"[a-z0-9-]+(\.[a-z0-9-]+)*\.?")

HEADERS: Final = {
    "Server": "eap",
    "Content-Security-Policy": (
        "default-src 'self'; img-src 'self' data:; object-src 'none'; base-uri 'none';"
        " form-action 'self'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
}
USER: Final[web.RequestKey[Principal | None]] = web.RequestKey("user")
"""User of a request; None if it has to log in."""
TOKEN: Final = web.RequestKey("token", str)
"""Its session, empty without one."""

logger = logging.getLogger(__name__)


def refusal(status: int, message: str, **headers: str) -> web.Response:
    """Return the answer to a request that is refused, ``{"error": {"message"}}``."""
    body = json.dumps({"error": {"message": message}}, ensure_ascii=False)
    # Bytes of a header that are no UTF-8 are surrogates in its text.
    encoded = body.encode("utf-8", "backslashreplace")
    return web.Response(
        status=status, body=encoded, content_type="application/json", headers=headers or None
    )


class Guard:
    """Checks of requests and logins.

    Args:
        section: The key ``web`` or ``metrics``.
        sessions: Sessions of its users.
    """

    def __init__(self, section: ServerSection, sessions: Sessions) -> None:
        self.sessions = sessions
        self._key = section.KEY
        self.has_logins = any(user.password for user in section.users)
        self.is_secure = section.tls is not None
        self._users = {user.name: user for user in section.users}
        role = role_of_anonymous(section)
        self._anonymous = None if role is None else Principal("", role)
        self._hosts = {name.lower().rstrip(".") for name in ("localhost", *section.hosts)}
        # The name of this computer is known without the plant file.
        self._hosts.add(os.uname().nodename.lower())
        self._proxy = section.proxy
        self._proxies = [
            ip_network(text, strict=False)
            for text in (section.proxy.networks if section.proxy else ())
        ]
        self._logins = Logins(section.users)
        self._rates: OrderedDict[tuple[str, bool], RateLimiter] = OrderedDict()
        self._remembered: OrderedDict[bytes, tuple[str, float]] = OrderedDict()

    @web.middleware
    async def check(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Answer a request that passes (middleware of the whole application)."""
        answer: web.StreamResponse
        try:
            answer = (
                self._refuse(request) or await self._identify(request) or await handler(request)
            )
        except web.HTTPException as exc:
            # Those of aiohttp: no such path or method, a body that is too long.
            answer = refusal(exc.status, exc.reason)
            if "Allow" in exc.headers:
                answer.headers["Allow"] = exc.headers["Allow"]
        except ConnectionError:
            raise  # the client has gone
        except Exception:
            # A defect; without this aiohttp answers with a text, and without the headers below.
            logger.exception("%s %r failed", request.method, request.path[:100])
            if "Upgrade" in request.headers:
                raise  # no answer can be sent on a WebSocket
            answer = refusal(500, "the page's server failed: see its log")
        if not answer.prepared:
            for name, value in HEADERS.items():
                answer.headers.setdefault(name, value)
            answer.headers.setdefault("Cache-Control", "no-store")
            if self.is_secure:
                answer.headers["Strict-Transport-Security"] = "max-age=31536000"
        return answer

    async def report_logins(self, view: LiveView) -> None:
        """Report refused logins to the appliances until cancelled."""

        async def send(refused: list[LoginRefusals]) -> None:
            for client in view.clients().values():
                await client.call(NOTE_LOGINS, transport=self._key, refused=tuple(refused))

        await self._logins.report(send)

    def host_of(self, request: web.Request) -> str:
        """Return the address of the client, also behind the proxy."""
        # The last entry is the proxy's own; those before it may be made up by the client.
        forwarded = request.headers.get("X-Forwarded-For", "").rpartition(",")[2].strip()
        if forwarded and self._is_proxy(request):
            return forwarded[:64]
        return request.remote or ""

    def refuse_foreign(self, request: web.Request) -> web.Response | None:
        """Return the refusal of a request that a page of another site sent, None for others."""
        origin = request.headers.get("Origin")
        if origin is not None:
            # Without the scheme: before a proxy with TLS it is another one.
            if origin.partition("://")[2].lower() != request.host.lower():
                return refusal(403, f"origin {origin[:100]} is another site")
        elif request.headers.get("Sec-Fetch-Site", "same-origin") not in {"same-origin", "none"}:
            return refusal(403, "the request comes from another site")
        return None

    def refuse_change(self, request: web.Request) -> web.Response | None:
        """Return the refusal of a change that is forged, or may be, None for others."""
        if (answer := self.refuse_foreign(request)) is not None:
            return answer
        # Pages of other sites send forms and plain text without a preflight, JSON only with one.
        if request.content_type != "application/json":
            return refusal(415, "expected Content-Type: application/json")
        if is_browser(request):
            given = request.headers.get(CSRF_HEADER, "").encode("utf-8", "replace")
            if not hmac.compare_digest(given, self.csrf(request).encode()):
                return refusal(403, f"header {CSRF_HEADER} is missing or old: reload the page")
        return None

    def csrf(self, request: web.Request) -> str:
        """Return the token that changes of this session need."""
        return self.sessions.csrf(request.get(TOKEN, ""))

    async def login(self, user: str, password: str, host: str) -> str | web.Response:
        """Return the token of a new session, or the refusal of a login."""
        answer = await self._verify(user, password, host)
        return answer or self.sessions.begin(user, token_hex(16), time())

    def set_cookie(self, response: web.Response, token: str) -> None:
        """Give a browser its session; an empty *token* takes it away."""
        max_age = SESSION_S if token else 0
        response.set_cookie(
            COOKIE,
            token,
            max_age=max_age,
            path="/",
            httponly=True,
            samesite="Strict",
            secure=self.is_secure,
        )

    def _refuse(self, request: web.Request) -> web.Response | None:
        if not self._is_known_host(request.host):
            name = request.host[:100]
            return refusal(
                403, f"host {name!r} is unknown here: add it to hosts of the key {self._key}"
            )
        is_file = not request.path.startswith(("/api/", "/metrics"))
        if not self._take_rate(self.host_of(request), is_file):
            return refusal(429, "too many requests", **{"Retry-After": "1"})
        return None

    def _is_known_host(self, text: str) -> bool:
        """Return whether a Host header is right; an address cannot be rebound to another one."""
        host = text.lower()
        is_ipv6 = host.startswith("[")
        host = host[1:].partition("]")[0] if is_ipv6 else host.partition(":")[0]
        try:
            ip_address(host)
        except ValueError:
            return _NAME.fullmatch(host) is not None and host.rstrip(".") in self._hosts
        return True

    def _take_rate(self, host: str, is_file: bool) -> bool:
        now_s = monotonic()
        key = host, is_file
        limiter = self._rates.get(key)
        if limiter is None:
            limiter = self._rates[key] = RateLimiter(*(_FILE_RATE if is_file else _RATE), now_s)
            # Memory is bounded: a client with many addresses pushes out those quiet for longest.
            if len(self._rates) > _MAX_HOSTS:
                self._rates.popitem(last=False)
        self._rates.move_to_end(key)
        return limiter.take(now_s)

    async def _identify(self, request: web.Request) -> web.Response | None:
        """Find the user of a request; return the refusal of wrong credentials."""
        request[USER] = self._anonymous
        request[TOKEN] = ""
        if self._proxy is not None and (name := request.headers.get(self._proxy.header)):
            return self._identify_by_proxy(request, name)
        if token := request.cookies.get(COOKIE, ""):
            # An expired session is as none: its browser gets the page of the login, not an error.
            found = self.sessions.find(token, time())
            if found is not None:
                request[USER], request[TOKEN] = found, token
        elif given := request.headers.get("Authorization"):
            return await self._identify_by_password(request, given)
        return None

    def _identify_by_proxy(self, request: web.Request, name: str) -> web.Response | None:
        # From any other host the header is a claim that nobody checked.
        if not self._is_proxy(request):
            return refusal(403, f"a user in a header is not taken from {request.remote}")
        user = self._users.get(name)
        if user is None:
            return refusal(
                403, f"unknown user {name[:100]!r}: add it to users of the key {self._key}"
            )
        request[USER] = Principal(user.name, user.role)
        return None

    def _is_proxy(self, request: web.Request) -> bool:
        if not self._proxies or not request.remote:
            return False
        remote = ip_address(request.remote)
        return any(remote in each for each in self._proxies)

    async def _identify_by_password(self, request: web.Request, given: str) -> web.Response | None:
        scheme, _, encoded = given.partition(" ")
        try:
            login, separator, password = b64decode(encoded, validate=True).decode().partition(":")
        except ValueError:
            separator = ""
        # Programs have no session: they send user and password with each request.
        if scheme.lower() != "basic" or not separator:
            return refusal(401, "expected Authorization: Basic")
        # Programs send the password with each request, and a check of it takes a tenth of a second
        # of a core: a right one is remembered for some minutes, as a digest.
        digest = hashlib.sha256(given.encode("utf-8", "replace")).digest()
        name, until_s = self._remembered.get(digest, ("", 0.0))
        if until_s < monotonic():
            refused = await self._verify(login, password, self.host_of(request))
            if refused is not None:
                return refused
            name = login
            self._remembered[digest] = name, monotonic() + _REMEMBERED_S
            if len(self._remembered) > _MAX_REMEMBERED:
                self._remembered.popitem(last=False)
        request[USER] = Principal(name, self._users[name].role)
        return None

    async def _verify(self, user: str, password: str, host: str) -> web.Response | None:
        """Return None if a password is right, else the refusal."""
        found = await self._logins.verify(user, password, host)
        if isinstance(found, Principal):
            return None
        wait = f"{found.wait_s:.0f}"
        match found.why:
            case LoginFailure.LOCKED:
                message = f"too many wrong passwords: wait {wait} s"
                return refusal(429, message, **{"Retry-After": wait})
            case LoginFailure.BUSY:
                return refusal(503, "too many logins at once", **{"Retry-After": wait})
            case LoginFailure.WRONG:
                return refusal(401, "unknown user or wrong password")


def is_browser(request: web.Request) -> bool:
    """Return whether a browser sent a request, and no program."""
    # A page of another site makes browsers send requests, never programs: these need no token.
    headers = request.headers
    return "Origin" in headers or "Sec-Fetch-Site" in headers or bool(request.get(TOKEN))


def needs_user(request: web.Request) -> Principal:
    """Return the user of a request; raise HTTPUnauthorized if it has to log in."""
    user = request[USER]
    if user is None:
        raise web.HTTPUnauthorized(reason="log in first")
    return user


async def read_json(request: web.Request) -> object:
    """Return the body of a request; raise HTTPBadRequest if it is not JSON."""
    try:
        async with asyncio.timeout(BODY_S):
            body = await request.read()
    except TimeoutError:
        raise web.HTTPRequestTimeout(reason="the body did not come in time") from None
    try:
        # json.loads() takes NaN, and half of a surrogate pair, which no text can have.
        return msgspec.json.decode(body)
    except (ValueError, RecursionError):
        raise web.HTTPBadRequest(reason="the body is not JSON") from None
