"""Loopback addresses: what stays on this machine needs no keys. Pure."""

from ipaddress import ip_address


def is_loopback(host: str) -> bool:
    """True for an address of the loopback interface, and for `localhost`. Other names are not resolved: False."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
