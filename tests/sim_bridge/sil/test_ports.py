"""Ports of programs that bind them some seconds later, and addresses of the operator's page."""

import socket
from pathlib import Path

import pytest

from shoal.errors import ConfigError
from sim_bridge.sil.ports import free_port, page_address

GIVEN_BY_THE_SYSTEM = Path("/proc/sys/net/ipv4/ip_local_port_range")


@pytest.mark.skipif(not GIVEN_BY_THE_SYSTEM.exists(), reason="only Linux says which ports it gives to connections")
def test_no_connection_of_another_program_takes_the_port_meanwhile() -> None:
    least, most = map(int, GIVEN_BY_THE_SYSTEM.read_text().split())
    assert not [port for port in (free_port() for _ in range(20)) if least <= port <= most]


@pytest.mark.parametrize(("family", "host"), [(socket.AF_INET, "127.0.0.1"), (socket.AF_INET6, "[::1]")], ids=["IPv4", "IPv6"])
def test_a_page_moves_to_another_port_only_where_its_own_is_taken(family: socket.AddressFamily, host: str) -> None:
    free = f"{host}:{free_port()}"
    assert page_address(free) == free
    with socket.socket(family) as taken:
        taken.bind((host.strip("[]"), 0))
        taken.listen()
        wanted = f"{host}:{taken.getsockname()[1]}"
        moved = page_address(wanted)
    assert moved != wanted and moved.startswith(f"{host}:")


def test_a_page_on_another_machines_address_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"--web 192\.0\.2\.1:8000: Cannot assign requested address"):
        page_address("192.0.2.1:8000")
