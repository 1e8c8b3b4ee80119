"""Settings of Zenoh that follow from an endpoint: most show only in an outage or in a crowd, which no other test waits for."""

from pathlib import Path
from typing import Any

import pytest

from shoal.bus.access_control import DOOR
from shoal.bus.endpoint import FLOOD, MOST_SESSIONS, Endpoint, client_of, settings
from shoal.bus.key_ring import Keys
from shoal.messages import topics

KEYS = Keys(Path("ring/agent-1"))
WAIT = "transport/link/tx/queue/congestion_control/block/wait_before_close"
ROUTERS = {f"transport/unicast/{name}" for name in ("max_sessions", "accept_pending", "accept_timeout")} | {"listen/endpoints"}
CLIENTS = {f"connect/{name}" for name in ("endpoints", "timeout_ms", "exit_on_failure", "retry")}
ALL = {
    "mode",
    "scouting/multicast/enabled",
    "scouting/gossip/enabled",
    "transport/link/tx/lease",
    *(f"transport/link/tx/queue/size/{queue}" for queue in ("real_time", "data_high", "data_low")),
    "transport/shared_memory/enabled",
    "timestamping/enabled",
}


@pytest.mark.parametrize("router", [False, True])
@pytest.mark.parametrize("lossless", [False, True])
def test_a_cut_link_is_missed_in_a_second_and_in_lockstep_in_two_minutes(router: bool, lossless: bool) -> None:
    values = settings(Endpoint(router=router, lossless=lossless))
    assert values["transport/link/tx/lease"] == (120_000 if lossless else 1000)  # ms
    assert values.get(WAIT) == (120_000_000 if lossless else None)  # us
    assert ("downsampling" in values) is (router and not lossless)
    extra = ({WAIT} if lossless else set()) | ({"downsampling"} if router and not lossless else set())
    assert set(values) == ALL | extra | (ROUTERS if router else CLIENTS)


def test_nothing_is_found_by_scouting_or_left_in_memory() -> None:
    for router in (False, True):
        values = settings(Endpoint(router=router))
        assert values["mode"] == ("router" if router else "client")
        off = ("scouting/multicast/enabled", "scouting/gossip/enabled", "transport/shared_memory/enabled")
        assert [values[name] for name in off] == [False] * 3 and values["timestamping/enabled"] is True
        assert {values[name] for name in values if "/queue/size/" in name} == {16}


def test_a_client_tries_again_and_a_router_takes_as_many_as_its_guard() -> None:
    client, router = settings(Endpoint("tcp/pool:1")), settings(Endpoint("tcp/pool:1", router=True))
    assert (client["connect/endpoints"], client["connect/exit_on_failure"]) == (["tcp/pool:1"], True)
    assert client["connect/timeout_ms"] == 1000
    assert client["connect/retry"] == {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2}
    assert router["listen/endpoints"] == ["tcp/pool:1"]
    assert router["transport/unicast/max_sessions"] == router["transport/unicast/accept_pending"] == MOST_SESSIONS
    assert router["transport/unicast/accept_timeout"] == 3000
    behind = settings(Endpoint("tls/pool:1", router=True, listens=("tls/127.0.0.1:2", "tls/127.0.0.1:3")))
    assert behind["listen/endpoints"] == ["tls/127.0.0.1:2", "tls/127.0.0.1:3"]


def test_plans_that_come_far_too_often_are_dropped_and_nothing_else() -> None:
    (rule,) = settings(Endpoint(router=True))["downsampling"]
    assert (rule["messages"], rule["flows"]) == (["put"], ["ingress"])
    assert rule["rules"] == [{"key_expr": "**/robot/*/plan", "freq": FLOOD * topics.PLAN.rate_hz}] and FLOOD >= 5


@pytest.mark.parametrize("router", [False, True])
def test_with_keys_both_sides_show_a_certificate_and_nothing_else_is_spoken(router: bool) -> None:
    access: dict[str, Any] = {"enabled": True}
    values = settings(Endpoint("tls/pool:1", router=router, keys=KEYS, access=access if router else None))
    tls = {name.rpartition("/")[2]: value for name, value in values.items() if "/link/tls/" in name}
    own = {"certificate": str(KEYS.certificate), "private_key": str(KEYS.private_key)}
    sides = ("listen", "connect") if router else ("connect",)
    assert tls == {
        "root_ca_certificate": str(KEYS.ca),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
        **{f"{side}_{name}": value for side in sides for name, value in own.items()},
    }
    assert values["transport/link/protocols"] == (["tls", DOOR] if router else ["tls"])
    assert values.get("access_control") == (access if router else None)
    assert not any("tls" in name or "protocols" in name for name in settings(Endpoint(router=router)))


@pytest.mark.parametrize(
    ("address", "own"),
    [("tls/0.0.0.0:7", "tls/127.0.0.1:7"), ("tcp/[::]:7", "tcp/[::1]:7"), ("tls/pool:7", "tls/pool:7")],
)
def test_another_session_of_a_routers_process_is_a_client_by_loopback(address: str, own: str) -> None:
    other = client_of(Endpoint(address, router=True, keys=KEYS, access={"enabled": True}))
    assert (other.address, other.router, other.access, other.keys) == (own, False, None, KEYS)
