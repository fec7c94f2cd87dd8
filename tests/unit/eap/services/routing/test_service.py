"""The two sides of a router: whoever stands there fits."""

from __future__ import annotations

from inspect import signature

import pytest

from eap.services.ads.ads_service import AdsService
from eap.services.routing.service import LocalClient, Service, TransportSender
from eap.services.transports.ams_tcp import AmsClients
from eap.services.transports.mailbox_frames import ChannelSender
from eap.services.transports.mailbox_stream import MailboxStreams
from tests.support.routing import RecordingSender, StubService


@pytest.mark.parametrize("service", [AdsService, StubService])
def test_services(service):
    for method in ("answer", "client_gone"):
        asked = [*signature(getattr(Service, method)).parameters]
        assert [*signature(getattr(service, method)).parameters] == asked


@pytest.mark.parametrize(
    "sender", [AmsClients, ChannelSender, RecordingSender, LocalClient, MailboxStreams]
)
def test_senders(sender):
    assert [*signature(sender.send).parameters] == [*signature(TransportSender.send).parameters]
