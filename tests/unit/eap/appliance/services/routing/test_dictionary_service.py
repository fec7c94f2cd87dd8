"""EAP ports behind their NetIDs."""

from __future__ import annotations

import asyncio

from eap.aoe.ads_notifications import Client, NotificationTable
from eap.aoe.ads_operation import Read
from eap.aoe.answer import AmsAnswer
from eap.aoe.way import Way
from eap.appliance.services.routing.dictionary_service import DictionaryService
from eap.appliance.services.routing.service import LocalRequest
from eap.codec.ads import AdsError
from eap.codec.adsnotification import AddNotification
from eap.codec.ams import decode_packet
from eap.ids import NetId
from tests.support import aoe

WAY = Way("door", "1")


class Ads:
    """Notes what it is asked."""

    notifications = NotificationTable()

    async def answer(self, command, body, client, *, judge):
        self.asked = command, body, client
        self.judge = judge
        return AmsAnswer(b"done")


def test_client_is_told_by_connection_and_address():
    ads = Ads()
    service = DictionaryService(ads)
    header, data = decode_packet(aoe.packet("1.1.1.1.2.1", aoe.READ, b"x"))
    assert header.target_port in service.ports
    answer = service.answer(LocalRequest(header, bytes(data), WAY))
    assert asyncio.run(answer) == AmsAnswer(b"done")
    assert ads.asked == (aoe.READ, b"x", Client(WAY, NetId.parse(aoe.CLIENT), 33000))
    assert ads.judge(Read(1, 2, 3)) is AdsError.NONE
    assert ads.judge(AddNotification(1, 2, 3, 4, 5, 6)) is AdsError.SERVICE
    service.client_gone(WAY)
    assert ads.notifications.stats().clients == 0
