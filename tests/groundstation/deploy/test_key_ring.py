"""The key ring on disk: who is in it, who can read it, and that no secret is ever shown."""

import errno
import json
import os
import re
import shutil
import stat
import subprocess
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zenoh
from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from typer.testing import CliRunner

from groundstation.__main__ import cli
from groundstation.deploy import certificate_authority, key_ring
from shoal.bus.key_ring import admitted, read_members
from shoal.errors import ConfigError
from shoal.messages.topics import Role
from shoal.runtime.output_files import replacing

NFT = shutil.which("nft", path=f"{os.environ.get('PATH', '')}:/usr/sbin")
NOW = datetime(2030, 5, 1, 12, 0, 0, tzinfo=UTC)


@pytest.fixture
def ring(tmp_path: Path) -> Path:
    key_ring.init(tmp_path / "keys", ["192.168.1.10", "pool.local"], "shoal", NOW)
    return tmp_path / "keys"


def certificate(ring: Path, process: str) -> x509.Certificate:
    return x509.load_pem_x509_certificate((ring / process / "cert.pem").read_bytes())


def name_of(certificate: x509.Certificate) -> str:
    return str(certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value)


def test_a_new_ring_has_everybody_but_robots(ring: Path) -> None:
    assert {m.role for m in admitted(ring, NOW)} == set(Role) - {Role.ROBOT}
    robot = key_ring.add(ring, "robot", 7, NOW)
    assert (robot.process, robot.expires) == ("agent-7", NOW + timedelta(days=397))
    assert [m.robot for m in admitted(ring, NOW) if m.role is Role.ROBOT] == [7]
    assert name_of(certificate(ring, "agent-7")) == robot.common_name


def test_a_list_with_a_time_of_nowhere_is_refused(ring: Path) -> None:
    """As somebody writes it by hand."""
    members = ring / "members.toml"
    members.write_text(re.sub(r"(expires = [^+\n]*)\+00:00", r"\1", members.read_text(), count=1))
    with pytest.raises(ConfigError, match=r"members\.toml: member\.0\.expires .*timezone"):
        read_members(ring)


def test_the_firewalls_rules_are_for_the_stations_port() -> None:
    printed = CliRunner().invoke(cli, ["keys", "firewall", "--listen", "tls/0.0.0.0:7555"])
    assert printed.exit_code == 0 and printed.output.count("tcp dport 7555 ct state new") == 2
    assert "@PORT@" not in printed.output


@pytest.mark.skipif(NFT is None, reason="nft is not installed")
def test_nft_takes_the_firewalls_rules(tmp_path: Path) -> None:
    (tmp_path / "guard.nft").write_text(CliRunner().invoke(cli, ["keys", "firewall"]).output, encoding="utf-8")
    checked = subprocess.run([str(NFT), "-c", "-f", str(tmp_path / "guard.nft")], capture_output=True, text=True, check=False)
    assert (checked.returncode, checked.stderr) == (0, "")


def test_certificates_are_signed_by_the_authority_for_the_uses_they_have(ring: Path) -> None:
    root = x509.load_pem_x509_certificate((ring / "ca.pem").read_bytes())
    for process in ("groundstation", "viewer"):
        own = certificate(ring, process)
        own.verify_directly_issued_by(root)
        uses = set(own.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value)
        assert (ExtendedKeyUsageOID.SERVER_AUTH in uses) == (process == "groundstation")
        assert not own.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
        private = load_pem_private_key((ring / process / "key.pem").read_bytes(), None)
        assert isinstance(private, ec.EllipticCurvePrivateKey)
        assert private.public_key() == own.public_key()
    names = certificate(ring, "groundstation").extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert "pool.local" in names.get_values_for_type(x509.DNSName)
    assert "192.168.1.10" in map(str, names.get_values_for_type(x509.IPAddress))


def test_private_keys_are_readable_by_the_owner_only(ring: Path) -> None:
    key_ring.add(ring, "robot", 1, NOW)
    secret = [path for path in ring.rglob("*") if path.suffix == ".key" or path.name in ("key.pem", "members.toml")]
    assert len(secret) == 8
    assert {stat.S_IMODE(path.stat().st_mode) for path in secret} == {0o600}
    folders = [ring, *(path for path in ring.iterdir() if path.is_dir())]
    assert {stat.S_IMODE(path.stat().st_mode) for path in folders} == {0o700}
    assert not list(ring.rglob("*.new"))


def test_a_new_certificate_replaces_the_old_and_no_name_comes_twice(ring: Path) -> None:
    first, second = (key_ring.add(ring, "robot", 1, NOW).common_name for _ in range(2))
    assert first != second
    assert [m.common_name for m in admitted(ring, NOW) if m.role is Role.ROBOT] == [second]
    assert [m.common_name for m in read_members(ring).member if m.revoked] == [first]


def test_the_revoked_and_the_expired_are_not_admitted(ring: Path) -> None:
    key_ring.add(ring, "robot", 1, NOW)
    key_ring.add(ring, "robot", 2, NOW, days=1)
    key_ring.revoke(ring, "agent-1", NOW)
    assert not (ring / "agent-1").exists()
    assert [m.robot for m in admitted(ring, NOW) if m.robot] == [2]
    assert [m.robot for m in admitted(ring, NOW + timedelta(days=2)) if m.robot] == []
    with pytest.raises(ConfigError, match=r"agent-1: has no certificate \(there are: groundstation.*agent-2\)"):
        key_ring.revoke(ring, "agent-1", NOW)


@pytest.mark.parametrize("host", ["", "a b", "pöol.local", "tls/10.0.0.1", "10.0.0.1:7447", "[::1]", "-x", "x" * 255])
def test_an_invalid_host_name_is_refused_before_keys_are_made(host: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no name or address of a host"):
        key_ring.init(tmp_path / "keys", ["pool.local", host], "shoal", NOW)
    assert list(tmp_path.iterdir()) == []


def test_the_station_has_the_hosts_that_were_named(tmp_path: Path) -> None:
    hosts = ["pool-1.lab.local", "x", "10.0.0.1", "fe80::1"]
    key_ring.init(tmp_path, hosts, "shoal", NOW)
    names = certificate(tmp_path, "groundstation").extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert {*hosts} <= {*names.get_values_for_type(x509.DNSName), *map(str, names.get_values_for_type(x509.IPAddress))}


def test_people_who_change_the_list_at_once_undo_nothing_of_one_another(ring: Path) -> None:
    changes: list[Callable[[], Any]] = [partial(key_ring.revoke, ring, "viewer", NOW)]
    changes += [partial(key_ring.add, ring, "robot", robot, NOW) for robot in range(1, 9)]
    with ThreadPoolExecutor(len(changes)) as people:
        for change in [people.submit(change) for change in changes]:
            change.result()
    valid = {m.process for m in read_members(ring).member if m.revoked is None}
    assert valid == {"groundstation", "operator", "localizer", "sim-bridge", *(f"agent-{robot}" for robot in range(1, 9))}


def test_a_missing_or_foreign_authority_signs_nothing(ring: Path, tmp_path: Path) -> None:
    key_ring.init(tmp_path / "other", [], "other", NOW)
    others, own = (folder / "authority.key" for folder in (tmp_path / "other", ring))
    certificate_authority = own.read_bytes()
    for wrong in (others.read_bytes(), b"junk"):
        own.write_bytes(wrong)
        with pytest.raises(ConfigError, match=r"keys/ca\.pem and .*keys/authority\.key: make no certificate"):
            key_ring.add(ring, "robot", 1, NOW)
    own.write_bytes(certificate_authority)
    (ring / "ca.pem").write_bytes(b"junk")
    with pytest.raises(ConfigError, match="make no certificate"):
        key_ring.add(ring, "robot", 1, NOW)
    assert not (ring / "agent-1").exists()


def test_a_ring_that_cannot_be_written_or_is_not_there_is_named(ring: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=r"file: File exists"):
        key_ring.init(tmp_path / "file", [], "shoal", NOW)
    (ring / "agent-1").touch()
    with pytest.raises(ConfigError, match=r"agent-1: File exists"):
        key_ring.add(ring, "robot", 1, NOW)
    with pytest.raises(ConfigError, match=r"nowhere: no key ring, members\.toml is missing in it"):
        key_ring.revoke(tmp_path / "nowhere", "agent-1", NOW)


@pytest.mark.parametrize("whole", [0, 1, 2])
def test_a_ring_whose_making_was_cut_short_is_made_by_another_try(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, whole: int
) -> None:
    """A full disk takes the first files, and not the next."""
    written = 0

    def fails(path: Path, *arguments: Any, **options: Any) -> Any:
        nonlocal written
        written += 1
        if written > whole:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        return replacing(path, *arguments, **options)

    with monkeypatch.context() as disk:
        disk.setattr(key_ring, "replacing", fails)
        with pytest.raises(ConfigError, match="No space left on device"):
            key_ring.init(tmp_path, [], "shoal", NOW)
    assert len(key_ring.init(tmp_path, [], "shoal", NOW)) == 5
    assert read_members(tmp_path).valid(NOW)


def test_harmful_key_ring_requests_are_refused(ring: Path) -> None:
    with pytest.raises(ConfigError, match="a new authority would lock every robot out"):
        key_ring.init(ring, [], "shoal", NOW)
    for role, robot in (("robot", 0), ("viewer", 3), ("robot", 50), ("robot", -1)):
        with pytest.raises(ConfigError, match="a robot needs its number, 1 to 49"):
            key_ring.add(ring, role, robot, NOW)
    for days in (0.0, -1.0, float("nan"), float("inf"), 3651.0):
        with pytest.raises(ConfigError, match=r"--days .*\(allowed: up to 3650 days\)"):
            key_ring.add(ring, "robot", 1, NOW, days)
    assert not list(ring.glob("agent-*"))
    with pytest.raises(ConfigError, match=r"'admin' is no role \(allowed: station, operator, robot"):
        key_ring.add(ring, "admin", 0, NOW)
    (ring / "authority.key").unlink()
    with pytest.raises(ConfigError, match=r"authority\.key: missing"):
        key_ring.add(ring, "robot", 1, NOW)


def test_commands_say_what_they_did_and_never_a_secret(tmp_path: Path) -> None:
    ring, run = tmp_path / "keys", CliRunner()
    outputs = []
    for arguments in (
        ["init", "--host", "192.168.1.10"],
        ["add", "robot", "3"],
        ["list"],
        ["revoke", "agent-3"],
        ["list"],
        ["router", "--listen", "tls/0.0.0.0:7447"],
    ):
        done = run.invoke(cli, ["keys", arguments[0], "--keys", str(ring), *arguments[1:]])
        assert done.exit_code == 0, done.output
        outputs.append(done.output)
    assert "agent-3" in outputs[2]
    assert "revoked" in outputs[4]
    assert "agent-3" not in outputs[5]
    config = json.loads(str(zenoh.Config.from_json5(outputs[5])))  # Zenoh knows every key of it
    assert config["access_control"]["default_permission"] == "deny"
    assert config["transport"]["link"]["tls"]["enable_mtls"] is True
    assert "PRIVATE KEY" not in "".join(outputs)
    assert "PRIVATE KEY" not in repr(certificate_authority.make_authority("shoal", NOW))
