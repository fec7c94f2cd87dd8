"""A router that says where it passes requests on to, for traces.

Own format, see :class:`~eap.ams.hop_report.HopQuestion`.
"""

from __future__ import annotations

from collections.abc import Awaitable, Container

from eap.ads.answer import AmsAnswer
from eap.ads.endpoint import Endpoint
from eap.ads.operation import AdsRefusedError, OperationOutcome, ReadWrite
from eap.ads.request import encode_outcome, parse_request
from eap.ams.hop_report import HopQuestion, encode_report
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.ams import AmsCommand
from eap.errors import CodecError
from eap.services.routing.service import LocalRequest, Service
from eap.services.routing.tracing import TracedStation, answer_question


class RouteQuery:
    """Stands before the system service of *station*, and answers questions of traces.

    Args:
        station: Whose router it is.
        rest: Answers everything else.
    """

    def __init__(self, station: TracedStation, rest: Service) -> None:
        self._station = station
        self._rest = rest

    @property
    def ports(self) -> Container[int]:
        """Those of the system service."""
        return self._rest.ports

    def answer(self, request: LocalRequest) -> AmsAnswer | Awaitable[AmsAnswer]:
        """Answer a request."""
        asked = _asked(request)
        return self._rest.answer(request) if asked is None else self._tell(request, asked)

    def client_gone(self, endpoint: Endpoint) -> None:
        """Pass it on."""
        self._rest.client_gone(endpoint)

    async def _tell(self, request: LocalRequest, asked: ReadWrite) -> AmsAnswer:
        try:
            question = HopQuestion.decode(asked.data)
        except CodecError:
            outcome = OperationOutcome(AdsError.SIZE)
        else:
            source = request.header.source
            report = await answer_question(self._station, question, request.came_by, source)
            data = encode_report(report)
            fits = len(data) <= asked.length
            outcome = OperationOutcome(data=data) if fits else OperationOutcome(AdsError.SIZE)
        return AmsAnswer(encode_outcome(AmsCommand.READ_WRITE, outcome))


def _asked(request: LocalRequest) -> ReadWrite | None:
    """Return the operation of a trace, None for any other request."""
    if request.header.command != AmsCommand.READ_WRITE:
        return None
    try:
        operation, *others = parse_request(request.header.command, request.body).operations
    except (AdsRefusedError, ValueError):
        return None
    if others or not isinstance(operation, ReadWrite):
        return None
    return operation if operation.group == IndexGroup.WHEREABOUTS else None
