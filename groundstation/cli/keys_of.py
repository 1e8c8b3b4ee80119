"""SHELL: `groundstation keys-of`: the keys of experiments and vehicles, searched (docs/reference/)."""

import dataclasses
import json
import re
from typing import Annotated

import typer

from shoal.runtime.cli_options import AsJson


def keys_of(
    pattern: Annotated[
        str, typer.Argument(metavar="[PATTERN]", help="A word or a regular expression, of the key or of its meaning.")
    ] = "",
    as_json: AsJson = False,
) -> None:
    """Print the keys that an experiment may have, with type, unit, range, default, meaning and an example.

    Keys that may change in flight are marked (live). Exit code 1 if no key matches.

    Examples:  groundstation keys-of horizon        groundstation keys-of '^sim.plant'        groundstation keys-of vehicle
    """
    from shoal.config.key_reference import tables

    try:
        expression = re.compile(pattern, re.IGNORECASE)
    except re.error as error:
        raise typer.BadParameter(f"{pattern!r} is no regular expression: {error}") from None
    of_vehicle = [
        dataclasses.replace(entry, name=f"vehicle.{entry.name}", example=f"vehicle.{entry.example}")
        for table in tables("vehicle")
        for entry in table.entries
    ]
    entries = [*(entry for table in tables("experiment") for entry in table.entries), *of_vehicle]
    matches = [entry for entry in entries if expression.search(entry.name) or expression.search(entry.meaning)]
    if as_json:
        typer.echo(json.dumps([dataclasses.asdict(entry) for entry in matches], indent=1))
    for entry in [] if as_json else matches:
        kind = f"  (kind {entry.when})" if entry.when else ""
        typer.echo(f"{entry.name}{kind}{'  (live)' if entry.live else ''}")
        facts = (f"{entry.type}, {entry.unit}" if entry.unit else entry.type, entry.allowed)
        default = entry.default if entry.default == "required" else f"default {entry.default}" if entry.default else ""
        typer.echo(f"    {'; '.join(fact for fact in (*facts, default) if fact)}")
        typer.echo(f"    {entry.meaning}")
        typer.echo(f"    --set {entry.example}")
    if not matches:
        typer.echo(f"{pattern}: no key has this in its name or meaning", err=True)
    raise typer.Exit(0 if matches else 1)
