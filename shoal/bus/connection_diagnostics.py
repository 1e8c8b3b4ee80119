"""SHELL: diagnosis of a connection that fails: a plain TCP and TLS handshake, step by step, with the process's own keys.

Zenoh says only that it could not connect. What a person needs to know is whether nobody listens there, the way is cut, the
station is another one, or it does not believe this process's certificate.
"""

import socket
import ssl

from shoal.bus.endpoint import parse_address
from shoal.bus.key_ring import Keys

CONNECT_S = 1.0
ALERT_S = 0.5  # TLS 1.3: a refused certificate is told after the handshake, in the place of the first answer


def trouble_reaching(address: str, keys: Keys | None) -> str:
    """The first failure on the way to `tcp/HOST:PORT` or `tls/HOST:PORT`; empty if there is none."""
    _, host, port = parse_address(address)
    try:
        with socket.create_connection((host, port), timeout=CONNECT_S) as plain:
            return _handshake(plain, host, keys) if keys is not None else ""
    except TimeoutError:
        return "no answer: is it switched on, and on this network?"
    except ConnectionRefusedError:
        return "connection refused: the machine is there, but no station listens on that port"
    except OSError as error:
        return f"{error.strerror or error}"


def trouble_listening(address: str) -> str:
    """The reason why no router can listen at `tcp/HOST:PORT` or `tls/HOST:PORT`; empty if one could."""
    try:
        with public_listener(address) as probe:
            probe.listen(1)
    except OSError as error:
        return f"{error.strerror or error}"
    return ""


def public_listener(address: str) -> socket.socket:
    """A socket bound to `tcp/HOST:PORT` or `tls/HOST:PORT`. Raises OSError."""
    _, host, port = parse_address(address)
    family, kind, _, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
    listener = socket.socket(family, kind)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(place)
    except OSError:
        listener.close()
        raise
    return listener


def _handshake(plain: socket.socket, host: str, keys: Keys) -> str:
    """Try a TLS handshake; returns the reason why it fails, or an empty text."""
    try:
        context = ssl.create_default_context(ssl.Purpose.SERVER_AUTH, cafile=str(keys.ca))
        context.load_cert_chain(keys.certificate, keys.private_key)
    except (OSError, ssl.SSLError) as error:
        return f"the keys in {keys.folder} cannot be used: {error}"
    try:
        with context.wrap_socket(plain, server_hostname=host) as secured:
            secured.settimeout(ALERT_S)
            secured.recv(1)
    except ssl.SSLCertVerificationError as error:
        return f"the station's certificate is not believed: {error.verify_message}"
    except ssl.SSLError as error:
        return _refused(error)
    except TimeoutError:
        return ""  # both believe each other, and the station waits for Zenoh to begin
    except OSError as error:
        return f"the station closed the connection: {error.strerror or error}"
    return ""


_ALERTS = {
    "CERTIFICATE_EXPIRED": "it has expired",
    "UNKNOWN_CA": "another authority made it",
    "CERTIFICATE_REQUIRED": "none was shown",
    "BAD_CERTIFICATE": "it is damaged",
}


def _refused(error: ssl.SSLError) -> str:
    """The reason for which the station ended a TLS handshake, from the alert that it sent."""
    reason = (error.reason or str(error)).upper()
    for alert, why in _ALERTS.items():
        if alert in reason:
            return f"the station does not accept this process's certificate: {why}"
    return f"TLS failed: {error.reason or error}"
