"""SHELL: the key ring on disk: made, added to, cut down. shoal/bus/key_ring.py says what lies where.

Private files are created with mode 0600 in folders of 0700, before the first byte is in them, and never printed.
"""

import fcntl
import os
import re
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path

import tomli_w

from groundstation.deploy import certificate_authority
from groundstation.deploy.certificate_authority import KeyPair
from shoal.bus.key_ring import CA, CERTIFICATE, MEMBERS, PRIVATE_KEY, ROLE_NAMES, Issued, MemberList, read_members
from shoal.config import LARGEST_ROBOT
from shoal.errors import ConfigError, os_errors_as_config_errors
from shoal.messages.topics import Role, process_name
from shoal.runtime.output_files import replacing, replacing_folder

AUTHORITY_KEY = "authority.key"
ALWAYS_HOSTS = ("localhost", "127.0.0.1", "::1")


def init(ring: Path, hosts: Sequence[str], fleet: str, now: datetime) -> list[Issued]:
    """A new ring: authority, and the members that every fleet has. Raises ConfigError where there is one already."""
    for host in hosts:
        if not _is_host(host):
            raise ConfigError(
                f"--host {host!r}: no name or address of a host (letters, digits, . and -; not a port, no brackets)"
            )
    with os_errors_as_config_errors(ring):
        if (ring / AUTHORITY_KEY).exists() or ((ring / CA).exists() and not _is_unused(ring)):
            raise ConfigError(
                f"{ring}: has keys already; a new authority would lock every robot out (choose another folder, or make what "
                "is missing in this one by `groundstation keys add`)"
            )
        if ring.is_dir():
            return _fill(ring, hosts, fleet, now)
        ring.parent.mkdir(parents=True, exist_ok=True)
        with replacing_folder(ring) as new:
            return _fill(new, hosts, fleet, now)


def _fill(ring: Path, hosts: Sequence[str], fleet: str, now: datetime) -> list[Issued]:
    """Put a new authority and its first members into a folder."""
    ring.chmod(0o700)
    root = certificate_authority.make_authority(fleet, now)
    # in this order: what is cut short before the last of them is made anew by another `init`
    _write_members(ring, MemberList(hosts=tuple(dict.fromkeys([*hosts, *ALWAYS_HOSTS]))))
    _write(ring / CA, root.certificate, 0o644)
    _write(ring / AUTHORITY_KEY, root.private_key, 0o600)
    return [add(ring, role, 0, now) for role in ("station", "operator", "localizer", "simulator", "viewer")]


def _is_unused(ring: Path) -> bool:
    """True if the ring's list is there and nobody has ever been on it: it was cut short. Raises ConfigError for a bad list."""
    return (ring / MEMBERS).exists() and not read_members(ring).member


def _is_host(text: str) -> bool:
    try:
        ip_address(text)
        return True
    except ValueError:
        return re.fullmatch(r"[A-Za-z0-9]([A-Za-z0-9.-]{0,251}[A-Za-z0-9])?", text) is not None


def add(ring: Path, role: str, robot: int, now: datetime, days: float = certificate_authority.MEMBER_DAYS) -> Issued:
    """A certificate for one process, in a folder of its name. An earlier one of that process no longer counts."""
    if role not in ROLE_NAMES:
        raise ConfigError(f"{role!r} is no role (allowed: {', '.join(ROLE_NAMES)})")
    if (ROLE_NAMES[role] is Role.ROBOT) != (robot != 0) or not 0 <= robot <= LARGEST_ROBOT:
        raise ConfigError(
            f"{role} {robot or ''}".rstrip() + f": a robot needs its number, 1 to {LARGEST_ROBOT}; other roles have none"
        )
    longest = certificate_authority.AUTHORITY_YEARS * 365
    if not 0.0 < days <= longest:
        raise ConfigError(f"--days {days:g}: no time for a certificate (allowed: up to {longest} days)")
    with _alone(ring):
        return _add(ring, role, robot, now, days)


def _add(ring: Path, role: str, robot: int, now: datetime, days: float) -> Issued:
    """Issue a certificate to a process of the fleet, and list it as a member. Raises ConfigError."""
    process = process_name(ROLE_NAMES[role], robot)
    members, root = read_members(ring), _authority(ring)
    common_name = certificate_authority.new_common_name(process)
    try:
        pair = certificate_authority.issue(root, common_name, members.hosts if role == "station" else (), now, days)
    except ValueError as error:
        raise ConfigError(f"{ring / CA} and {ring / AUTHORITY_KEY}: make no certificate: {error}") from None
    try:
        with replacing_folder(ring / process) as folder:
            _write(folder / CA, root.certificate, 0o644)
            _write(folder / CERTIFICATE, pair.certificate, 0o644)
            _write(folder / PRIVATE_KEY, pair.private_key, 0o600)
    except OSError as error:
        raise ConfigError(f"{ring / MEMBERS}: not changed: {error.filename}: {error.strerror}") from None
    issued = Issued(
        process=process,
        role=role,
        robot=robot,
        common_name=common_name,
        issued=_seconds(now),
        expires=_seconds(now + timedelta(days=days)),
    )
    earlier = _without(members, process, now)
    with os_errors_as_config_errors(ring):
        _write_members(ring, earlier.model_copy(update={"member": (*earlier.member, issued)}))
    return issued


def revoke(ring: Path, process: str, now: datetime) -> None:
    """Strike a process off the list. Raises ConfigError where it is not on it."""
    with _alone(ring), os_errors_as_config_errors(ring):
        members = read_members(ring)
        valid = [m.process for m in members.member if m.revoked is None]
        if process not in valid:
            raise ConfigError(f"{process}: has no certificate (there are: {', '.join(valid) or 'none'})")
        _write_members(ring, _without(members, process, now))
        if (ring / process).is_dir():
            shutil.rmtree(ring / process)


@contextmanager
def _alone(ring: Path) -> Iterator[None]:
    """Wait until no other command changes the ring's list: of two that read it at once, one would undo what the other wrote,
    a revocation for example. A file system that knows no locks lets everybody in."""
    read_members(ring)  # says what is wrong with a folder that is no ring
    with os_errors_as_config_errors(ring):
        folder = os.open(ring, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        with suppress(OSError):
            fcntl.flock(folder, fcntl.LOCK_EX)
        yield
    finally:
        os.close(folder)


def _without(members: MemberList, process: str, now: datetime) -> MemberList:
    """The list with whatever that process had revoked."""
    stamp = _seconds(now)
    kept = (
        m.model_copy(update={"revoked": stamp}) if m.process == process and m.revoked is None else m for m in members.member
    )
    return members.model_copy(update={"member": tuple(kept)})


def _authority(ring: Path) -> KeyPair:
    """Certificate and private key of the ring's authority. Raises ConfigError if one is missing."""
    with os_errors_as_config_errors(ring):
        for path in (ring / CA, ring / AUTHORITY_KEY):
            if not path.is_file():
                raise ConfigError(f"{path}: missing (`groundstation keys init` makes it; put it back if it is in a safe)")
        return KeyPair((ring / CA).read_bytes(), (ring / AUTHORITY_KEY).read_bytes())


def _write_members(ring: Path, members: MemberList) -> None:
    table = members.model_dump(mode="python", exclude_none=True)
    _write(ring / MEMBERS, tomli_w.dumps(table).encode(), 0o600)


def _write(path: Path, data: bytes, mode: int) -> None:
    """Write all of it or nothing, with these permissions from the beginning."""
    with replacing(path, mode=mode) as file:
        file.write(data)


def _seconds(when: datetime) -> datetime:
    return when.astimezone(UTC).replace(microsecond=0)
