"""IPv4 addresses of hosts by name, looked up without waiting for a name server.

The executor of asyncio would be waited for when the process ends; a name server that does not
answer must not hold that up.
"""

from __future__ import annotations

import asyncio
import socket
from contextlib import suppress
from ipaddress import IPv4Address
from threading import Thread


async def resolve(host: str) -> str:
    """Return the address of *host*, which may be one already.

    Raises:
        OSError: there is no such name, or nobody says whose it is.
    """
    try:
        return str(IPv4Address(host))
    except ValueError:
        pass
    loop = asyncio.get_running_loop()
    found: asyncio.Future[str] = loop.create_future()

    def take(result: str | OSError) -> None:
        if found.done():
            return
        if isinstance(result, str):
            found.set_result(result)
        else:
            found.set_exception(result)

    def look_up() -> None:
        result: str | OSError
        try:
            result = socket.gethostbyname(host)
        except OSError as exc:
            result = exc
        except UnicodeError:
            result = OSError(f"{host!r} is not a host name")
        with suppress(RuntimeError):  # the loop has ended meanwhile
            loop.call_soon_threadsafe(take, result)

    Thread(target=look_up, name=f"resolve {host}", daemon=True).start()
    return await found
