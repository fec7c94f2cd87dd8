"""The ``eapctl`` command: a module for each area, imported when one of its commands is used.

The front end owns no plant: it reads plant files, starts an appliance in the foreground, or talks
to running ones through their control sockets.  A command calls an operation of
``eap.ops``, which returns a typed result; ``output`` renders that as JSON or by the
command's view.  ``group`` loads subcommands and is the one place where an error becomes a line on
stderr and an exit code.
"""

from __future__ import annotations

import click

from eap.cli.group import LazyGroup


@click.group(
    cls=LazyGroup,
    commands_at={
        "apply": "eap.cli.plant:apply",
        "bus": "eap.cli.bus:bus",
        "check": "eap.cli.plant:check",
        "decode": "eap.cli.decode:decode",
        "gateway": "eap.cli.gateway:gateway",
        "gw": "eap.cli.gateway:gw",
        "new": "eap.cli.plant:new",
        "od": "eap.cli.od:od",
        "pd": "eap.cli.pd:pd",
        "plan": "eap.cli.plant:plan",
        "rollback": "eap.cli.plant:rollback",
        "routes": "eap.cli.routes:routes",
        "run": "eap.cli.plant:run",
        "scan": "eap.cli.network:scan",
        "sim": "eap.cli.sim:sim",
        "state": "eap.cli.od:state",
        "status": "eap.cli.status:status",
        "trace": "eap.cli.network:trace",
    },
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(package_name="eap-appliance", message="eapctl %(version)s")
def main() -> None:
    """EtherCAT Automation Protocol appliance.

    Exit codes: 0 done, 1 refused or failed, 2 usage, configuration or environment.
    """
