"""The quality of service that travels with what is sent: what comes first, and what is dropped where a link is full."""

import pytest
import zenoh

from shoal.bus.endpoint import Endpoint
from shoal.bus.zenoh_transport import ZenohTransport
from shoal.messages.topics import Qos
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
