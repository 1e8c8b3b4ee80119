"""The address of the fleet's router, and every setting of Zenoh that follows from it. Pure.

All settings are explicit, so a network without multicast and a Zenoh with other defaults behave the same.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from shoal.bus.access_control import DOOR
from shoal.bus.key_ring import Keys
from shoal.errors import ConfigError
from shoal.messages.topics import PLAN

PATIENT_MS = 120_000  # lease and congestion limit in lockstep: a starved machine is slow, not cut off
LEASE_MS = 1000  # a cut link is noticed after this long (default 10 s); at 400 ms a busy laptop loses healthy links
FLOOD = 10  # times a topic's rate: above it messages are dropped; a busy machine sends what it held back in bursts
FORMS = "tcp/HOST:PORT or tls/HOST:PORT, for example tls/192.0.2.10:7447"
WILDCARDS = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}  # by address listened at: the address to connect to from the same machine
MOST_SESSIONS = 4096  # of a router: more than its guard lets in (MOST_LINKS of gate/guard.py); Zenoh's own is 1,000
ACCEPT_MS = 3000  # for a session to be opened after its handshake; shorter than YOUNG_S of groundstation/gate/admission.py
TRY_MS = 1000  # one attempt to reach the station: Zenoh does not hear Ctrl-C meanwhile


def parse_address(address: str) -> tuple[str, str, int]:
    """Protocol, host and port of a Zenoh endpoint. Raises ConfigError naming the forms it may have."""
    protocol, slash, rest = address.partition("/")
    host, _, port = rest.partition("#")[0].rpartition(":")
    host = host.strip("[]")
    try:
        host.encode("idna")
    except UnicodeError:
        host = ""
    if not slash or protocol not in ("tcp", "tls") or not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ConfigError(f"{address!r}: not a place where a station can be (allowed: {FORMS})")
    return protocol, host, int(port)


@dataclass(frozen=True)
class Endpoint:
    """The address of the fleet's Zenoh router, and the role of this process towards it."""

    address: str = "tcp/127.0.0.1:7447"
    router: bool = False
    lossless: bool = False  # wait for a congested peer instead of dropping: only where no robot waits meanwhile (lockstep)
    keys: Keys | None = None  # mutual TLS
    access: Mapping[str, Any] | None = None  # router: Zenoh's access_control section (shoal/bus/access_control.py)
    insecure: bool = False  # open to other machines, as was asked for
    listens: tuple[
        str, ...
    ] = ()  # router with keys: where it listens instead, behind its guard and its door (groundstation/gate/gate.py)


def client_of(endpoint: Endpoint) -> Endpoint:
    """Endpoint of a client of the same router, for another session of its process. A router that listens at every address of
    its machine is called by loopback: no certificate names a wildcard."""
    protocol, host, port = parse_address(endpoint.address)
    address = f"{protocol}/{WILDCARDS[host]}:{port}" if host in WILDCARDS else endpoint.address
    return replace(endpoint, address=address, router=False, access=None)


def settings(endpoint: Endpoint) -> dict[str, Any]:
    """Every setting of Zenoh that differs from its default, by its path in the configuration."""
    values: dict[str, Any] = {
        "mode": "router" if endpoint.router else "client",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/tx/lease": PATIENT_MS if endpoint.lossless else LEASE_MS,
        # poses of 20 robots go out at once, each in a batch of its own: with 2 (default) a busy machine lost 29 %, with 16 3 %
        "transport/link/tx/queue/size/real_time": 16,
        "transport/link/tx/queue/size/data_high": 16,
        "transport/link/tx/queue/size/data_low": 16,  # a whole frame fits; with 2 (default) a busy machine lost 3 % of them
        "transport/shared_memory/enabled": False,  # leaves files when killed; frames have a ring of their own (frame_ring.py)
        "timestamping/enabled": True,  # the advanced publisher's cache needs it
    }
    if endpoint.lossless:
        values["transport/link/tx/queue/congestion_control/block/wait_before_close"] = PATIENT_MS * 1000
    if endpoint.router and not endpoint.lossless:  # in lockstep rates are any
        values["downsampling"] = _flood_limits()
    if endpoint.router:
        values["listen/endpoints"] = list(endpoint.listens) or [endpoint.address]
        values["transport/unicast/max_sessions"] = MOST_SESSIONS
        values["transport/unicast/accept_pending"] = MOST_SESSIONS  # with 100 (default) that many silent links block the rest
        values["transport/unicast/accept_timeout"] = ACCEPT_MS
    else:
        values["connect/endpoints"] = [endpoint.address]
        values["connect/timeout_ms"] = TRY_MS
        values["connect/exit_on_failure"] = True
        values["connect/retry"] = {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2}
    if endpoint.keys is not None:
        values |= _tls(endpoint.keys, endpoint.router)
    if endpoint.access is not None:
        values["access_control"] = endpoint.access
    return values


def _flood_limits() -> list[dict[str, Any]]:
    """A robot's program gone wild must not drown the others: of plans, which robots read of each other, the router drops what
    comes too often, before it is decoded. Counted for each sender. Not of events: each one counts."""
    rules = [{"key_expr": f"**/{PLAN.key()}", "freq": FLOOD * PLAN.rate_hz}]
    return [{"id": "flood", "messages": ["put"], "flows": ["ingress"], "rules": rules}]


def _tls(keys: Keys, router: bool) -> dict[str, Any]:
    """TLS: both sides show a certificate of the fleet's authority; the router's must name the host that was asked for."""
    values: dict[str, Any] = {
        "transport/link/protocols": ["tls", DOOR] if router else ["tls"],
        "transport/link/tls/root_ca_certificate": str(keys.ca),
        "transport/link/tls/enable_mtls": True,
        "transport/link/tls/verify_name_on_connect": True,
        "transport/link/tls/close_link_on_expiration": True,
    }
    for side in ("listen", "connect") if router else ("connect",):
        values[f"transport/link/tls/{side}_certificate"] = str(keys.certificate)
        values[f"transport/link/tls/{side}_private_key"] = str(keys.private_key)
    return values
