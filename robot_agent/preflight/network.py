"""SHELL: network part of `robot-agent check`: certificate, connection to the station, its clock, and a running agent."""

import time
from collections.abc import Generator
from datetime import UTC, datetime
from pathlib import Path

from robot_agent.host.config import AgentConfig
from robot_agent.preflight import findings
from robot_agent.preflight.findings import CheckFinding, CheckVerdict
from shoal.bus.bus import Bus
from shoal.bus.connection_diagnostics import trouble_reaching
from shoal.bus.key_ring import Keys, common_name, open_keys
from shoal.bus.network import endpoint
from shoal.bus.zenoh_transport import ZenohTransport
from shoal.errors import ConfigError, Unreached
from shoal.messages import topics
from shoal.messages.messages import StationHeartbeat
from shoal.messages.topics import Role, process_name
from shoal.runtime.version import code

STATION_WITHIN_S = 3.0
PRESENT_WITHIN_S = 0.5  # after the station is heard: who is there already the router tells in its own time


def check_network(config: AgentConfig) -> Generator[CheckFinding, None, bool]:
    """Check certificate, connection to the station, and clock. Returns True if an agent of this robot is on the network
    already."""
    process = process_name(Role.ROBOT, config.robot)
    keys = None
    if config.keys is not None:
        try:
            keys = open_keys(Path(config.keys), process)
            yield _certificate(keys)
        except ConfigError as error:
            yield CheckFinding("certificate", CheckVerdict.FAIL, str(error))
            return False
    try:
        where = endpoint(config.station, process, None if keys is None else Path(config.keys or ""), insecure=config.insecure)
    except ConfigError as error:
        yield CheckFinding("station", CheckVerdict.FAIL, str(error))
        return False
    if where.insecure:
        yield CheckFinding(
            "certificate", CheckVerdict.WARN, "none: the network is open, every program on it can command the robots"
        )
    trouble = trouble_reaching(where.address, where.keys)
    if trouble:
        yield CheckFinding("station", CheckVerdict.FAIL, f"{where.address}: {trouble}")
        return False
    try:
        with Bus(ZenohTransport(where, patience_s=STATION_WITHIN_S), config.fleet) as bus:
            beats = bus.inbox(topics.HEARTBEAT, StationHeartbeat)
            bus.watch_presence()
            bus.wait(lambda: beats.newest_header() is not None, STATION_WITHIN_S)
            received, now_ns = beats.newest(), time.time_ns()
            since_ns = received.age_ns(time.monotonic_ns()) if received is not None else 0
            flying = bus.wait(lambda: process in bus.present, PRESENT_WITHIN_S)
    except Unreached as error:
        yield CheckFinding("station", CheckVerdict.FAIL, str(error))
        return False
    if received is None:
        why = "a router answers, but no station is heard; is `groundstation run` on, under the same --fleet?"
        yield CheckFinding("station", CheckVerdict.FAIL, f"{where.address}: {why}")
        return flying
    yield CheckFinding("station", CheckVerdict.OK, f"{where.address}: heard, its mission is {received.message.mission}")
    yield findings.same_code(received.message.code, code().short)
    yield findings.clock((now_ns - received.header.stamp_ns - since_ns) * 1e-9)
    return flying


def _certificate(keys: Keys) -> CheckFinding:
    """Check the process's own certificate: by its authority, and valid now."""
    from cryptography import x509  # a fleet without keys has no use for it

    try:
        own = x509.load_pem_x509_certificate(keys.certificate.read_bytes())
        own.verify_directly_issued_by(x509.load_pem_x509_certificate(keys.ca.read_bytes()))
    except Exception as error:  # the library has a dozen ways to say that a file is no good; each is the answer here
        return CheckFinding("certificate", CheckVerdict.FAIL, f"{keys.certificate}: not of the authority beside it: {error}")
    return findings.certificate(common_name(keys), own.not_valid_before_utc, own.not_valid_after_utc, datetime.now(UTC))
