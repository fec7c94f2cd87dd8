"""Errors of buses and slaves as results of ADS, with their text for traces and logs."""

from __future__ import annotations

from eap.aoe.ads_operation import AdsRefusedError
from eap.errors import EapError
from eap.gateway.error_table import ads_result


def refusal(error: EapError) -> AdsRefusedError:
    """Return the result that comes nearest to what *error* says, with its text."""
    return AdsRefusedError(ads_result(error), str(error))
