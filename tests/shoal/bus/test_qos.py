"""The quality of service that travels with what is sent: what comes first, and what is dropped where a link is full."""

import errno
from pathlib import Path

import pytest
import zenoh

from shoal.bus.endpoint import Endpoint
from shoal.bus.key_ring import Keys
from shoal.bus.zenoh_transport import RouterGate, ZenohTransport
from shoal.errors import ConfigError, Unreached
from shoal.messages.topics import Qos
from sim_bridge.sil.ports import free_port
from tests.waiting import eventually

pytestmark = pytest.mark.real_time

P = zenoh.Priority


@pytest.mark.parametrize("lossless", [False, True])
def test_control_goes_first_pictures_last_and_nothing_waits_but_in_lockstep(address: str, lossless: bool) -> None:
    expected = {
        Qos.CONTROL: (P.REAL_TIME, True),
        Qos.STATE: (P.DATA_HIGH, True),
        Qos.IMAGE: (P.DATA_LOW, False),
        Qos.JOURNAL: (P.DATA, False),
        Qos.EVENT: (P.DATA, False),
    }
    config = zenoh.Config()
    for key, value in {
        "mode": '"client"',
        "connect/endpoints": f'["{address}"]',
        "scouting/multicast/enabled": "false",
    }.items():
        config.insert_json5(key, value)
    came: dict[str, tuple[zenoh.Priority, bool, zenoh.CongestionControl]] = {}

    def note(sample: zenoh.Sample) -> None:
        came[str(sample.key_expr)] = sample.priority, sample.express, sample.congestion_control

    transport = ZenohTransport(Endpoint(address, lossless=lossless))
    try:
        with zenoh.open(config) as reader, reader.declare_subscriber("qos/*", note):
            puts = {
                qos: transport.publisher(f"qos/{qos.name}", qos, 4 if qos in (Qos.EVENT, Qos.JOURNAL) else 0) for qos in Qos
            }

            def all_came() -> bool:
                for put in puts.values():
                    put(b"payload", b"header")
                return len(came) == len(puts)

            assert eventually(all_came)
    finally:
        transport.close()
    full = zenoh.CongestionControl.BLOCK if lossless else zenoh.CongestionControl.DROP
    assert came == {f"qos/{qos.name}": (*expected[qos], full) for qos in Qos}


def test_a_wait_for_the_station_ends_with_the_process_and_with_patience() -> None:
    address = f"tcp/127.0.0.1:{free_port()}"
    with pytest.raises(Unreached, match=f"stopped while waiting for the station at {address}: "):
        ZenohTransport(Endpoint(address), stopped=lambda: True)
    with pytest.raises(Unreached, match=f"no station at {address}: "):
        ZenohTransport(Endpoint(address), patience_s=0.0)


def test_a_router_with_keys_is_never_without_a_gate() -> None:
    with pytest.raises(ValueError, match="a router with keys needs a gate"):
        ZenohTransport(Endpoint("tls/127.0.0.1:7447", router=True, keys=Keys(Path("ring/groundstation"))))


def test_a_public_port_that_cannot_be_had_is_told() -> None:
    def taken(endpoint: Endpoint) -> RouterGate:
        raise OSError(errno.EADDRINUSE, "Address already in use")

    endpoint = Endpoint("tls/127.0.0.1:7447", router=True, keys=Keys(Path("ring/groundstation")))
    with pytest.raises(ConfigError, match=r"cannot listen at tls/127.0.0.1:7447: Address already in use"):
        ZenohTransport(endpoint, gate=taken)
