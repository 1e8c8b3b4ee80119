"""SHELL: free ports of this machine, for programs that are about to be started."""

import errno
import os
import random
import socket

from shoal.errors import ConfigError

OURS = range(15000, 32000)  # below the ports that Linux (from 32768 on) and macOS (from 49152 on) give to outgoing connections


def free_port(kind: socket.SocketKind = socket.SOCK_STREAM) -> int:
    """A free TCP port; a UDP port with SOCK_DGRAM. None that the system hands out: on a busy machine seconds go by until the
    program that gets it has bound it, and any connection of another program could take it meanwhile."""
    for port in random.SystemRandom().sample(OURS, len(OURS)):
        with socket.socket(socket.AF_INET, kind) as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
    raise RuntimeError(f"no free port from {OURS.start} to {OURS.stop - 1}")


def page_address(address: str) -> str:
    """`address` (host:port), or the same host with another port if that one is taken: two runs may go on side by side. Raises
    ConfigError for what is no address."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ConfigError(f"--web {address!r}: must be HOST:PORT, for example 127.0.0.1:8000")
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host.strip("[]"), int(port)))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise ConfigError(f"--web {address}: {error.strerror or error}") from None
            return f"{host}:{free_port()}"
    return address


def free_base_port(robots: tuple[int, ...]) -> int:
    """A UDP port p such that p + id is free for every robot. The search begins at a port that depends on the process,
    because of two runs that start together neither has bound its ports yet when the other searches."""
    bases = list(range(14550, 60000, 100))
    first = os.getpid() % len(bases)
    for base in bases[first:] + bases[:first]:
        probes = []
        try:
            for robot in robots:
                probe = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
                probes.append(probe)
                probe.bind(("127.0.0.1", base + robot))
            return base
        except OSError:
            continue
        finally:
            for probe in probes:
                probe.close()
    raise RuntimeError("no free UDP ports for the thruster boards")
