"""Rules for values that users set: roles, limits and comments of ``set`` panels."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from eap.ams.spec import Role
from eap.config.web_sections import CommentRule, SetPanel, WebPage
from eap.runtime.logins import Principal

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
