"""The ``eapctl`` command: one module a subcommand, imported only when it is used.

The front end owns no plant: it reads plant files, starts an appliance in the foreground, or talks
to running ones through their control sockets.  ``group`` loads subcommands and is the one place
where an error becomes a line on stderr and an exit code.
"""

from __future__ import annotations

import click

from eap.cli.group import LazyGroup


@click.group(
    cls=LazyGroup,
    commands_at={
        "apply": "eap.cli.apply:apply",
        "bus": "eap.cli.bus:bus",
        "check": "eap.cli.check:check",
        "decode": "eap.cli.decode:decode",
        "gateway": "eap.cli.gateway:gateway",
        "gw": "eap.cli.gw:gw",
        "new": "eap.cli.new:new",
        "od": "eap.cli.od:od",
        "pd": "eap.cli.pd:pd",
        "plan": "eap.cli.plan:plan",
        "rollback": "eap.cli.apply:rollback",
        "routes": "eap.cli.routes:routes",
        "run": "eap.cli.run:run",
        "scan": "eap.cli.scan:scan",
        "sim": "eap.cli.sim:sim",
        "state": "eap.cli.state:state",
        "status": "eap.cli.status:status",
        "trace": "eap.cli.trace:trace",
    },
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(package_name="eap-appliance", message="eapctl %(version)s")
def main() -> None:
    """EtherCAT Automation Protocol appliance.

    Exit codes: 0 done, 1 refused or failed, 2 usage, configuration or environment.
    """
