"""An EAP port as a service: behind its NetID and AMS port 0xFFFF."""

from __future__ import annotations

from collections.abc import Awaitable

from eap.aoe.ads_notifications import Client
from eap.aoe.ads_operation import DeleteNotification, Operation
from eap.aoe.answer import AmsAnswer
from eap.aoe.way import Way
from eap.appliance.services.eap_ads import DEVICE_PORT, EapAds
from eap.appliance.services.routing.service import LocalRequest
from eap.codec.ads import AdsError
from eap.codec.adsnotification import AddNotification


class DictionaryService:
    """Answers for one port."""

    ports = frozenset((DEVICE_PORT,))

    def __init__(self, ads: EapAds) -> None:
        self._ads = ads

    def answer(self, request: LocalRequest) -> AmsAnswer | Awaitable[AmsAnswer]:
        """Read or write the dictionary, states and variables."""
        header = request.header
        client = Client(request.came_by, header.source, header.source_port)
        return self._ads.answer(header.command, request.body, client, judge=_without_notifications)

    def client_gone(self, way: Way) -> None:
        """Forget the notifications of a connection."""
        self._ads.notifications.forget(way)


def _without_notifications(operation: Operation) -> AdsError:
    is_told = isinstance(operation, AddNotification | DeleteNotification)
    return AdsError.SERVICE if is_told else AdsError.NONE
