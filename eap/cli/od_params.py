"""What the commands about a device have in common: TARGET and ``--plant``."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, Any

import click

from eap.cli.params import plant_option

if TYPE_CHECKING:
    from eap.appliance.commands.od_target import Target


def target_argument(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add TARGET as the first argument and ``--plant``; the function gets *target*."""

    @wraps(command)
    def with_target(*args: Any, target: str, plant: str | None, **params: Any) -> Any:
        return command(*args, target=_target(target, plant), **params)

    return click.argument("target", metavar="TARGET")(plant_option(with_target))


def _target(text: str, plant: str | None) -> Target:
    from eap.appliance.commands.od_target import Target

    try:
        return Target.parse(text)._replace(plant=plant)
    except ValueError as exc:
        raise click.UsageError(str(exc)) from None
