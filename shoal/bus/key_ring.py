"""SHELL: a process's own keys: the folder they lie in, and whether they can be used.

A key ring is a folder with one folder per process, named as the process is:

    keys/ca.pem  members.toml  authority.key      only where the station runs; the last belongs in a safe
    keys/agent-1/ca.pem  cert.pem  key.pem        all that robot 1's board gets

`groundstation keys` makes it. Private keys are read by OpenSSL and Zenoh, from the file; nothing here looks at them.
"""

import ssl
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Annotated

from pydantic import AwareDatetime, Field

from shoal.bus.access_control import Member
from shoal.config.loader import Section, check, read_toml
from shoal.errors import ConfigError, os_errors_as_config_errors
from shoal.messages.topics import Role
from shoal.system.secret_files import refuse_shared

CA, CERTIFICATE, PRIVATE_KEY, MEMBERS = "ca.pem", "cert.pem", "key.pem", "members.toml"
EXPIRES_SOON = timedelta(days=30)
ROLE_NAMES = {
    "station": Role.STATION,
    "operator": Role.OPERATOR,
    "robot": Role.ROBOT,
    "localizer": Role.LOCALIZER,
    "simulator": Role.SIMULATOR,
    "viewer": Role.VIEWER,
}


@dataclass(frozen=True)
class Keys:
    """One process's certificate, private key, and the authority that it believes."""

    folder: Path

    @property
    def ca(self) -> Path:
        """Certificate of the fleet's authority."""
        return self.folder / CA

    @property
    def certificate(self) -> Path:
        """The certificate of this process."""
        return self.folder / CERTIFICATE

    @property
    def private_key(self) -> Path:
        """The proof of it."""
        return self.folder / PRIVATE_KEY


class Issued(Section):
    """A certificate that the fleet's authority has given out."""

    process: str
    role: Annotated[str, Field(pattern=f"^({'|'.join(ROLE_NAMES)})$")]
    robot: Annotated[int, Field(ge=0, le=999)] = 0
    common_name: str
    issued: AwareDatetime
    expires: AwareDatetime
    revoked: AwareDatetime | None = None


class MemberList(Section):
    """members.toml: every certificate ever given out."""

    hosts: tuple[str, ...] = ()  # where the station can be reached: names and addresses in its certificate
    member: tuple[Issued, ...] = ()

    def valid(self, now: datetime) -> tuple[Issued, ...]:
        """The certificates that count."""
        return tuple(m for m in self.member if m.revoked is None and now < m.expires)


def open_keys(ring: Path, process: str) -> Keys:
    """The keys of one process. Raises ConfigError if a file is missing, damaged, of another process, or readable by others."""
    keys = Keys(ring / process)
    with os_errors_as_config_errors(keys.folder):
        for path in (keys.ca, keys.certificate, keys.private_key):
            if not path.is_file():
                raise ConfigError(f"--keys {ring}: {path} is missing (made by `groundstation keys add`, copied by `deploy`)")
            path.open("rb").close()
    refuse_shared(keys.private_key, "the private key")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    try:
        context.load_verify_locations(keys.ca)
    except ssl.SSLError:
        raise ConfigError(f"{keys.ca}: not a certificate (made by `groundstation keys`, copied by `deploy`)") from None
    try:
        context.load_cert_chain(keys.certificate, keys.private_key, password="")  # no prompt for one
    except ssl.SSLError as error:
        why = (error.reason or "not PEM").lower().replace("_", " ")
        raise ConfigError(f"{keys.certificate} and {keys.private_key}: not a certificate and its key: {why}") from None
    owner = common_name(keys)
    if owner.partition(".")[0] != process:  # the router would let it in, and keep to itself whatever it says
        raise ConfigError(f"{keys.certificate}: is {owner}'s, this is {process} (`groundstation keys add` makes one for it)")
    return keys


def common_name(keys: Keys) -> str:
    """Name by which the router knows a process: its own, a dot, and a part that no other certificate has."""
    from cryptography import x509  # a fleet without keys has no use for it
    from cryptography.x509.oid import NameOID

    certificate = x509.load_pem_x509_certificate(keys.certificate.read_bytes())
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else "nobody"


def read_members(ring: Path) -> MemberList:
    """Everybody who has a certificate. Raises ConfigError where there is no such list, or it is no good."""
    with os_errors_as_config_errors(ring):
        if not (ring / MEMBERS).exists():
            raise ConfigError(f"--keys {ring}: no key ring, {MEMBERS} is missing in it (`groundstation keys init` makes one)")
    return check(MemberList, read_toml(ring / MEMBERS), str(ring / MEMBERS))


def expiring(ring: Path, now: datetime) -> tuple[Issued, ...]:
    """Members whose certificate ends within EXPIRES_SOON. Their links are closed at that time, also in flight."""
    return tuple(m for m in read_members(ring).valid(now) if m.expires - now < EXPIRES_SOON)


def admitted(ring: Path, now: datetime) -> tuple[Member, ...]:
    """Members that the router lets in."""
    return tuple(Member(ROLE_NAMES[m.role], m.common_name, m.robot) for m in read_members(ring).valid(now))
