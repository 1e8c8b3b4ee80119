"""The fleet's certificate authority: a self-signed root and certificates under it, one per process. Bytes in, bytes out.

ECDSA on P-256: what every TLS library has, and quick on a small board. A member's certificate says who it is by its common
name, which no other certificate ever bears: so a name that is struck off the router's list stays off. Only the station's may
serve TLS; a robot cannot pass for it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

AUTHORITY_YEARS = 10
MEMBER_DAYS = 397  # a season, and the next one's beginning
CLOCKS_APART = timedelta(days=1)  # valid from before now: a board without a clock of its own is often behind
YEAR = timedelta(days=365)


@dataclass(frozen=True)
class KeyPair:
    """A certificate and its private key, PEM. The key stays out of every printed form."""

    certificate: bytes
    private_key: bytes

    def __repr__(self) -> str:
        return "Pair(...)"


def make_authority(fleet: str, now: datetime) -> KeyPair:
    """A new root for a fleet."""
    key = ec.generate_private_key(ec.SECP256R1())
    # Not every fleet's the same: then a stranger's certificate is one of an unknown authority, not one with a bad signature.
    name = _name(new_common_name(f"{fleet} authority"))
    usage = x509.KeyUsage(
        digital_signature=False,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=True,
        crl_sign=True,
        encipher_only=False,
        decipher_only=False,
    )
    root = (
        _builder(key, name, now, now + AUTHORITY_YEARS * YEAR)
        .issuer_name(name)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(usage, critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .sign(key, hashes.SHA256())
    )
    return _pair(root, key)


def new_common_name(process: str) -> str:
    """A name that no certificate had before: the process's, and 32 random bits."""
    return f"{process}.{x509.random_serial_number() & 0xFFFFFFFF:08x}"


def issue(authority: KeyPair, common_name: str, hosts: Sequence[str], now: datetime, days: float = MEMBER_DAYS) -> KeyPair:
    """A certificate for a member. With `hosts` (names and addresses) it may be the station there. Raises ValueError for an
    authority that is none, or is put together from two."""
    root = x509.load_pem_x509_certificate(authority.certificate)
    signer = load_pem_private_key(authority.private_key, password=None)
    if not isinstance(signer, ec.EllipticCurvePrivateKey) or signer.public_key() != root.public_key():
        raise ValueError("the private key is not that of the authority's certificate")
    key = ec.generate_private_key(ec.SECP256R1())
    uses = [ExtendedKeyUsageOID.CLIENT_AUTH, *([ExtendedKeyUsageOID.SERVER_AUTH] if hosts else [])]
    builder = (
        _builder(key, _name(common_name), now, now + timedelta(days=days))
        .issuer_name(root.subject)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage(uses), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key()), critical=False)
    )
    if hosts:
        builder = builder.add_extension(x509.SubjectAlternativeName([_general_name(host) for host in hosts]), critical=False)
    return _pair(builder.sign(signer, hashes.SHA256()), key)


def _builder(key: ec.EllipticCurvePrivateKey, name: x509.Name, now: datetime, until: datetime) -> x509.CertificateBuilder:
    """Fields that all certificates have: a name, a public key, a serial number, a time in which they are valid."""
    return (
        x509.CertificateBuilder()
        .subject_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now.astimezone(UTC) - CLOCKS_APART)
        .not_valid_after(until.astimezone(UTC))
    )


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _general_name(host: str) -> x509.GeneralName:
    """A host's name or address as a certificate has it."""
    try:
        return x509.IPAddress(ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _pair(certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey) -> KeyPair:
    private = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    return KeyPair(certificate.public_bytes(Encoding.PEM), private)
