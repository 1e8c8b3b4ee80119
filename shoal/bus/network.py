"""SHELL: from a command line to an endpoint: plain on this machine, mutual TLS and access control beyond it.

Off loopback a network without keys lets every program on it command the robots. That must be asked for (`--insecure`), and
then it is shown: in every process's log, and on the operator's page.
"""

import logging
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from shoal.bus.access_control import INSECURE, access_control
from shoal.bus.endpoint import Endpoint, parse_address
from shoal.bus.key_ring import admitted, expiring, open_keys
from shoal.errors import ConfigError
from shoal.system.loopback import is_loopback

log = logging.getLogger("shoal")


def refuse_open(address: str, insecure: bool) -> None:
    """Raises ConfigError for an address that needs keys, to be used where there are none."""
    protocol, host, _ = parse_address(address)
    if protocol == "tls":
        raise ConfigError(f"{address}: TLS needs --keys FOLDER (`groundstation keys init` makes them)")
    if not is_loopback(host) and not insecure:
        raise ConfigError(
            f"{address}: other machines could command the robots; off loopback a fleet needs --keys FOLDER "
            "(`groundstation keys init` makes them, docs/security.md), or an explicit --insecure"
        )


def endpoint(
    address: str,
    process: str,
    ring: Path | None,
    *,
    insecure: bool = False,
    router: bool = False,
    lossless: bool = False,
    fleet: str = "shoal",
) -> Endpoint:
    """The endpoint for an address, with keys where a key ring is given. With a key ring always TLS, whatever the address says.
    Raises ConfigError for a network that would be open to others without having been asked for."""
    _, host, _ = parse_address(address)
    if ring is not None:
        if insecure:
            raise ConfigError("--insecure and --keys: with keys the network is not open; leave one of them out")
        keys = open_keys(ring, process)
        return Endpoint(address_with(ring, address), router, lossless, keys, _access(fleet, ring) if router else None)
    refuse_open(address, insecure)
    if not is_loopback(host):
        log.warning(INSECURE)
    return Endpoint(address, router, lossless, insecure=not is_loopback(host))


def address_with(ring: Path | None, address: str) -> str:
    """The address that is used for another: with a key ring always TLS. Raises ConfigError for what is none."""
    _, host, port = parse_address(address)
    return address if ring is None else f"tls/[{host}]:{port}" if ":" in host else f"tls/{host}:{port}"


def _access(fleet: str, ring: Path) -> dict[str, Any]:
    """The router's access control for the members of a key ring. Warns of certificates that end soon."""
    now = datetime.now(UTC)
    for member in expiring(ring, now):
        log.warning("the certificate of %s ends on %s UTC", member.process, f"{member.expires:%Y-%m-%d %H:%M}")
    return access_control(fleet, admitted(ring, now))
