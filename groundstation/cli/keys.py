"""SHELL: `groundstation keys`: the fleet's authority and its certificates."""

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from shoal.runtime.cli_options import DEFAULT_FLEET, DEFAULT_STATION, FleetName, ListenAddress, finite
from shoal.runtime.output import terminal

keys_cli = typer.Typer(
    help="Certificates: who belongs to the fleet, and as what (docs/security.md).",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)

Ring = Annotated[Path, typer.Option("--keys", metavar="FOLDER", envvar="SHOAL_KEYS", help="The key ring.")]
DEFAULT_RING = Path("keys")


@keys_cli.command()
def init(
    host: Annotated[
        list[str] | None,
        typer.Option(metavar="HOST", help="Name or address of the station, as others call it. Repeatable."),
    ] = None,
    ring: Ring = DEFAULT_RING,
    fleet: FleetName = DEFAULT_FLEET,
) -> None:
    """Make the fleet's authority, and certificates for station, operator, localizer, simulator and viewer.

    Example:  groundstation keys init --host 192.0.2.10 --host pool-laptop.local
    """
    from groundstation.deploy import key_ring

    certificates = key_ring.init(ring, host or [], fleet, datetime.now(UTC))
    typer.echo(f"{ring}: authority, {', '.join(m.process for m in certificates)}")
    typer.echo(f"{ring / key_ring.AUTHORITY_KEY} makes new members: keep it where only you can read it")
    typer.echo("`groundstation keys firewall` prints rules for the station's machine against strangers who knock at its port")


@keys_cli.command()
def add(
    role: Annotated[str, typer.Argument(metavar="ROLE", help="station, operator, robot, localizer, simulator or viewer.")],
    robot: Annotated[int, typer.Argument(metavar="ROBOT", help="A robot's number.")] = 0,
    days: Annotated[float, typer.Option(min=0.01, max=3650, help="How long it is valid.", callback=finite)] = 397.0,
    ring: Ring = DEFAULT_RING,
) -> None:
    """Make a certificate; an earlier one of the same process no longer counts once the station has been restarted.

    Example:  groundstation keys add robot 3
    """
    from groundstation.deploy import key_ring

    issued = key_ring.add(ring, role, robot, datetime.now(UTC), days)
    typer.echo(f"{ring / issued.process}: valid until {issued.expires:%Y-%m-%d %H:%M} UTC. {_AFTER}")


@keys_cli.command()
def revoke(
    process: Annotated[str, typer.Argument(metavar="PROCESS", help="As `keys list` names it, for example agent-3.")],
    ring: Ring = DEFAULT_RING,
) -> None:
    """Strike a process off the list of those that the router lets through.

    Zenoh has no revocation lists: the certificate stays good for TLS until it expires, but its name may no longer say or hear
    anything. The router reads the list when it starts.

    Example:  groundstation keys revoke agent-2
    """
    from groundstation.deploy import key_ring

    key_ring.revoke(ring, process, datetime.now(UTC))
    typer.echo(f"{process} is revoked. {_AFTER}")


@keys_cli.command("list")
def list_members(ring: Ring = DEFAULT_RING) -> None:
    """List the processes that have a certificate, and its expiry.

    Example:  groundstation keys list
    """
    from rich.table import Table

    from shoal.bus.key_ring import EXPIRES_SOON, read_members

    now, table = datetime.now(UTC), Table("process", "role", "common name", "valid until (UTC)", "state")
    for m in read_members(ring).member:
        state = "revoked" if m.revoked else "expired" if m.expires <= now else ""
        if not state and m.expires - now < EXPIRES_SOON:
            state = f"expires in {(m.expires - now).days} days"
        table.add_row(m.process, m.role, m.common_name, f"{m.expires:%Y-%m-%d %H:%M}", state)
    terminal().print(table)


@keys_cli.command()
def router(listen: ListenAddress = DEFAULT_STATION, ring: Ring = DEFAULT_RING, fleet: FleetName = DEFAULT_FLEET) -> None:
    """Print the configuration of an external `zenohd` (JSON5), with the same TLS and access control as the station's own.

    Example:  groundstation keys router --listen tls/0.0.0.0:7447 > zenohd.json5
    """
    from shoal.bus.endpoint import settings
    from shoal.bus.network import endpoint

    flat = settings(endpoint(listen, "groundstation", ring, router=True, fleet=fleet))
    nested: dict[str, object] = {}
    for key, value in flat.items():
        node: dict[str, object] = nested
        *parents, last = key.split("/")
        for parent in parents:
            node = node.setdefault(parent, {})  # type: ignore[assignment]
        node[last] = value
    typer.echo(json.dumps(nested, indent=1))


@keys_cli.command()
def firewall(listen: ListenAddress = DEFAULT_STATION) -> None:
    """Print firewall rules (nftables) for the station's port: what one address opens too often is dropped by the kernel.

    An additional measure: a station that has keys has a guard of its own in front of its router. An external router has none.

    Example:  groundstation keys firewall --listen tls/0.0.0.0:7447 | sudo nft -f -
    """
    from shoal.bus.endpoint import parse_address

    _, _, port = parse_address(listen)
    typer.echo(FIREWALL.read_text(encoding="utf-8").replace("@PORT@", str(port)), nl=False)


FIREWALL = Path(__file__).parents[1] / "deploy" / "templates" / "guard.nft"
_AFTER = "Takes effect when the station, which is the router, is started again."
