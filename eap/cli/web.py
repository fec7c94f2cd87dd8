"""``eapctl web``: the page for browsers by hand, and password hashes of its users."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import click

from eap.cli.output import write_text
from eap.cli.params import PLANT_FILE
from eap.errors import ConfigError, EnvironmentalError

if TYPE_CHECKING:
    from eap.config.web_sections import WebSection
    from eap.live.client import LiveClient


@click.command()
@click.argument("plant", type=PLANT_FILE, required=False)
@click.option(
    "--connect",
    "hosts",
    multiple=True,
    metavar="HOST",
    help="Show the stations of another host, by ADS; repeatable.",
)
@click.option("--listen", metavar="ADDRESS:PORT", help="Instead of the plant file's address.")
@click.option(
    "--password",
    "user",
    metavar="NAME",
    help="Ask for a password, and print the line of this user for the plant file.",
)
def web(plant: Path | None, hosts: tuple[str, ...], listen: str | None, user: str | None) -> None:
    """Serve the pages of the plant file PLANT, which runs on this host or on HOST.

    Without PLANT, or without pages in it, there is one page of the plant and one for each station.
    A plant that runs with the key 'web' has its page already.  Ends with Ctrl-C.

    Examples: eapctl web config/demo.yaml, eapctl web --connect 10.0.0.5, eapctl web --password anna
    """
    if user is not None:
        _print_user(user)
        return
    if plant is None and not hosts:
        raise click.UsageError("name a plant file, or a host with --connect")
    if find_spec("aiohttp") is None:
        raise EnvironmentalError(
            "aiohttp is not installed: the page needs it; pip install 'eap-appliance[web]'"
        )
    name, section = _read(plant, listen)
    remote = _clients(hosts)
    from eap.web.process import page_url, run  # aiohttp takes 0.2 s
    from eap.web.server import open_listener, tls_context

    context = tls_context(section)
    run(
        section,
        name,
        open_listener(section),
        context,
        ready=lambda: click.echo(f"{page_url(section)} (Ctrl-C ends it)", err=True),
        remote=remote,
    )


def _read(plant: Path | None, listen: str | None) -> tuple[str, WebSection]:
    from msgspec.structs import replace

    from eap.ams.spec import Role
    from eap.config.listen import parse_listen
    from eap.config.web_sections import WebSection

    name, section = "", WebSection()
    if plant is not None:
        from eap.ops.plant import load_or_raise

        loaded = load_or_raise(plant)
        name, section = loaded.name, loaded.web or section
    if listen is None:
        return name, section
    try:
        is_loopback = parse_listen(listen).is_loopback
    except ValueError as exc:
        raise click.UsageError(f"--listen: {exc}; expected such as 127.0.0.1:8080") from None
    is_open = section.anonymous not in {None, Role.VIEWER}
    if not is_loopback and (section.tls is None or not section.users or is_open):
        raise ConfigError(
            f"--listen: {listen} is reached by other hosts: name a plant file whose key web has"
            " users and tls, and anonymous at most viewer"
        )
    return name, replace(section, listen=listen)


def _clients(hosts: tuple[str, ...]) -> dict[str, LiveClient]:
    from functools import partial

    from eap.live.ads_connection import AdsConnection, RemoteHost
    from eap.live.client import LiveClient

    clients = {}
    for host in hosts:
        try:
            address = RemoteHost.parse(host)
        except ValueError as exc:
            raise click.UsageError(f"--connect: {exc}") from None
        clients[host] = LiveClient(partial(AdsConnection.open, address))
    return clients


def _print_user(name: str) -> None:
    import os

    import msgspec

    from eap.config.passwords import MAX_PASSWORD, MIN_PASSWORD, PasswordHash

    if sys.stdin.isatty():
        password = click.prompt("Password", hide_input=True, confirmation_prompt=True, err=True)
    else:
        password = sys.stdin.readline().rstrip("\n")
    if len(password) < MIN_PASSWORD or len(password.encode()) > MAX_PASSWORD:
        raise click.UsageError(
            f"--password: the password has {len(password)} characters; expected at least"
            f" {MIN_PASSWORD}, and at most {MAX_PASSWORD} bytes"
        )
    found = PasswordHash.of(password, os.urandom(16))
    # JSON texts are YAML texts: a name may need quotes.
    quoted = msgspec.json.encode(name).decode()
    write_text(f'- {{name: {quoted}, role: operator, password: "{found}"}}')
