"""Refused logins of all servers: counted for the status, and written to the audit."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from time import time
from typing import Any

from eap.control.logins import NOTE_LOGINS, NotedLogins, NoteLoginsParameters
from eap.runtime.logins import LoginFailure, LoginRefusals
from eap.services.control.audit import Audit

ROUTE_LOGINS = "ams-udp"
"""Transport of requests for routes, whose lines in the audit are written with their results."""
_RECENT_S = 900.0
_WORDS = {
    LoginFailure.WRONG: "unknown user or wrong password",
    LoginFailure.LOCKED: "too many wrong passwords before",
    LoginFailure.BUSY: "too many logins at once",
}


class LoginLog:
    """Refused logins, by transport.

    Args:
        plant: Its name, for findings.
        audit: Gets a line for each user and host.
        now: Unix time in seconds.
    """

    def __init__(self, plant: str, audit: Audit, *, now: Callable[[], float] = time) -> None:
        self._plant = plant
        self._audit = audit
        self._now = now
        self._counts: dict[str, dict[LoginFailure, int]] = {}
        self._last: dict[str, tuple[float, str]] = {}

    def table(self) -> dict[str, Callable[[dict[str, Any]], Any]]:
        """Return the method of servers by name."""
        return dict((NOTE_LOGINS.served_by(self._note_logins),))

    def note(self, transport: str, refused: Iterable[LoginRefusals]) -> None:
        """Count refused logins, and write them to the audit."""
        counts = self._counts.setdefault(transport, dict.fromkeys(LoginFailure, 0))
        for each in refused:
            counts[each.why] += each.count
            self._last[transport] = self._now(), f"{each.user!r} from {each.host or 'many hosts'}"
            if transport != ROUTE_LOGINS:
                self._audit.write_login(
                    transport, each.host, each.user, each.count, _WORDS[each.why]
                )

    async def note_routes(self, refused: Iterable[LoginRefusals]) -> None:
        """Count refused logins of requests for routes."""
        self.note(ROUTE_LOGINS, refused)

    def report(self) -> dict[str, dict[str, int]]:
        """Return the entry of ``status``: numbers by transport and reason."""
        return {
            transport: {str(why): count for why, count in counts.items()}
            for transport, counts in self._counts.items()
        }

    def findings(self) -> list[dict[str, Any]]:
        """Return a warning for each transport with refused logins in the last minutes."""
        found = []
        for transport, (at_s, last) in self._last.items():
            if self._now() - at_s > _RECENT_S:
                continue
            counts = self._counts[transport]
            total, locked = sum(counts.values()), counts[LoginFailure.LOCKED]
            found.append(
                {
                    "severity": "warning",
                    "where": f"{self._plant} {transport}",
                    "what": f"{total} logins refused, {locked} of them locked out; last {last}",
                    "advice": "the audit has users and hosts",
                    "since": at_s,
                }
            )
        return found

    def _note_logins(self, wanted: NoteLoginsParameters) -> NotedLogins:
        self.note(wanted.transport, wanted.refused)
        return NotedLogins(sum(each.count for each in wanted.refused))
