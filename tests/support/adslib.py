"""Connections of AdsLib, Beckhoff's client library, which pyads loads."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pyads


def open_connection(net_id: str, port: int, address: str) -> pyads.Connection:
    """Return a connection that stays open: AdsLib may crash where it closes one that notified."""
    import pyads

    connection = pyads.Connection(net_id, port, address)
    connection.open()
    return connection
