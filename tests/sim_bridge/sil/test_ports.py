"""Ports for programs that bind them some seconds later."""

from pathlib import Path

import pytest

from sim_bridge.sil.ports import free_port

GIVEN_BY_THE_SYSTEM = Path("/proc/sys/net/ipv4/ip_local_port_range")


@pytest.mark.skipif(not GIVEN_BY_THE_SYSTEM.exists(), reason="only Linux says which ports it gives to connections")
def test_no_connection_of_another_program_takes_the_port_meanwhile() -> None:
    least, most = map(int, GIVEN_BY_THE_SYSTEM.read_text().split())
    assert not [port for port in (free_port() for _ in range(20)) if least <= port <= most]
