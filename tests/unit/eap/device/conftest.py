from __future__ import annotations

import pytest

from eap.device.eap_dictionary import EapDictionary
from tests.support.stations import BLANK


@pytest.fixture
def udp() -> EapDictionary:
    return EapDictionary(BLANK, "eap0")


@pytest.fixture
def ethernet() -> EapDictionary:
    return EapDictionary(BLANK, "eap1")
