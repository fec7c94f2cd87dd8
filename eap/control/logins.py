"""Method of the control protocol by which servers with users report refused logins."""

from __future__ import annotations

from typing import Literal

from eap.control.protocol import Method, Parameters
from eap.runtime.logins import LoginRefusals


class NoteLoginsParameters(Parameters, frozen=True):
    """``note_logins``: logins that a server refused, for the audit and the status."""

    transport: Literal["web", "metrics", "opcua"]
    refused: tuple[LoginRefusals, ...]


class NotedLogins(Parameters, frozen=True):
    """Answer: the number of refused logins that were noted."""

    noted: int


NOTE_LOGINS = Method("note_logins", NoteLoginsParameters, NotedLogins)
