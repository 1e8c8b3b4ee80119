"""Addresses of the operator's page: what is taken, and what cannot be had."""

import socket

import pytest

from sim_bridge.sil.ports import free_port, page_address
from wire.toml_loader import ConfigError


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
