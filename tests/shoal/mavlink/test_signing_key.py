"""Key files that only their owner can read, and times of signatures that never come back."""

import os
import stat
from functools import partial
from pathlib import Path

import pytest

from shoal.errors import ConfigError
from shoal.mavlink.board_port import open_link
from shoal.mavlink.signing import EPOCH_NS, TICK_NS
from shoal.mavlink.signing_key import AHEAD_TICKS, Signing, TimestampStore, load_key, new_key


def test_a_new_key_is_its_owners_alone_and_is_never_written_over(tmp_path: Path) -> None:
    file = tmp_path / "robot-1.key"
    new_key(file)
    assert file.stat().st_mode & 0o777 == 0o600
    key = load_key(file, 7)
    assert (key.secret.hex(), key.link_id) == (file.read_text().strip(), 7)
    with pytest.raises(ConfigError, match="File exists"):
        new_key(file)
    other = tmp_path / "other.key"
    new_key(other)
    assert load_key(other).secret != key.secret


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o777])
def test_a_key_that_others_can_reach_is_refused(tmp_path: Path, mode: int) -> None:
    file = tmp_path / "robot-1.key"
    new_key(file)
    file.chmod(mode)
    with pytest.raises(ConfigError, match="allowed: 0600"):
        load_key(file)


def test_a_key_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such link key"):
        load_key(tmp_path / "robot-1.key")


def test_times_go_on_after_a_restart_whatever_the_clock_says(tmp_path: Path) -> None:
    file = tmp_path / "stamps"
    used = 0
    for hour in (5, 6, 2, 0, -100_000, 7):  # the clock is set, and set back, between the lives
        now_ns = EPOCH_NS + hour * 3_600_000_000_000
        stamps = TimestampStore(file, partial(int, now_ns))
        assert stamps() > used or stamps() == used == 0
        used = stamps() + 5000  # as many frames within one tick
        stamps.renew(used)
        assert int(file.read_text()) > used


def test_the_file_is_renewed_long_before_it_is_used_up(tmp_path: Path) -> None:
    now = [EPOCH_NS]
    stamps = TimestampStore(tmp_path / "stamps", lambda: now[0])
    written = []
    for _ in range(200):
        now[0] += 1_000_000_000
        stamps.renew(stamps())
        limit = int((tmp_path / "stamps").read_text())
        assert limit - stamps() >= AHEAD_TICKS // 2 - 1
        written.append(limit)
    assert 5 <= len(set(written)) <= 8
    assert TICK_NS * AHEAD_TICKS == 60_000_000_000


@pytest.mark.parametrize("content", ["", "soon", "1.5", "\0" * 16, "-1", "9" * 20])
def test_times_that_cannot_be_read_are_explained(tmp_path: Path, content: str) -> None:
    (tmp_path / "stamps").write_text(content)
    with pytest.raises(ConfigError, match=r"cannot be kept.*loss of power.*remove the file"):
        TimestampStore(tmp_path / "stamps")


def test_the_first_times_are_on_the_disk_before_a_frame_is_signed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file that is new, and renamed before its bytes are on the disk, is empty after a loss of power: the robot would not
    start again. Later ones are written from the control loop, which does not wait."""
    synced, fsync = [], os.fsync

    def noted(descriptor: int) -> None:
        fsync(descriptor)
        if stat.S_ISREG(os.fstat(descriptor).st_mode):  # the folder follows
            synced.append(os.fstat(descriptor).st_size)

    monkeypatch.setattr(os, "fsync", noted)
    stamps = TimestampStore(tmp_path / "stamps", lambda: EPOCH_NS + TICK_NS)
    assert synced == [len((tmp_path / "stamps").read_text())]
    stamps.renew(2 * AHEAD_TICKS)
    assert len(synced) == 1


def test_times_that_cannot_be_written_are_explained(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be kept"):
        TimestampStore(tmp_path / "nowhere" / "stamps")


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"\xff\xfe", "robot-1.key: cannot be read as a link key: not a text"),
        (b"", "robot-1.key: not a link key (allowed: 64 hexadecimal digits; make one with `robot-agent link-key FILE`"),
        (b"abc", "not a link key (allowed: 64 hexadecimal digits"),
        (b"ab" * 33, "not a link key (allowed: 64 hexadecimal digits"),
        (b"ab" * 31, "not a link key (allowed: 64 hexadecimal digits"),
        (b"x" * 64, "not a link key (allowed: 64 hexadecimal digits"),
    ],
)
def test_a_file_that_is_no_key_is_refused_and_its_content_not_shown(tmp_path: Path, content: bytes, says: str) -> None:
    file = tmp_path / "robot-1.key"
    file.write_bytes(content)
    file.chmod(0o600)
    with pytest.raises(ConfigError) as refused:
        load_key(file)
    assert says in str(refused.value)
    assert not content or content.decode("latin1") not in str(refused.value)


def test_a_folder_is_no_key(tmp_path: Path) -> None:
    (tmp_path / "robot-1.key").mkdir(mode=0o700)
    with pytest.raises(ConfigError, match="cannot be read as a link key: is no regular file"):
        load_key(tmp_path / "robot-1.key")


def test_programs_with_one_key_have_times_of_their_own(tmp_path: Path) -> None:
    new_key(tmp_path / "robot-1.key")
    Signing.of(tmp_path / "robot-1.key", "agent")
    Signing.of(tmp_path / "robot-1.key", "params", 1)
    assert {path.name for path in tmp_path.iterdir()} == {
        "robot-1.key",
        "robot-1.key.agent-stamps",
        "robot-1.key.params-stamps",
    }


def test_a_service_keeps_its_times_where_it_may_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    home, state = tmp_path / "home", tmp_path / "state"
    home.mkdir()
    state.mkdir()
    new_key(home / "robot-1.key")
    monkeypatch.setenv("STATE_DIRECTORY", str(state))
    Signing.of(home / "robot-1.key", "agent")
    assert [path.name for path in (*home.iterdir(), *state.iterdir())] == ["robot-1.key", "robot-1.key.agent-stamps"]


def test_unsigned_udp_stays_on_this_machine() -> None:
    open_link("udp:127.0.0.1:14551").close()
    open_link("udp:localhost:14551").close()
    with pytest.raises(ConfigError, match=r"unsigned UDP leaves this machine.*--link-key FILE.*--link-insecure"):
        open_link("udp:192.0.2.1:14551")
    open_link("udp:192.0.2.1:14551", secured=True).close()
    with pytest.raises(ConfigError, match="is no address of a host"):
        open_link("udp:no-such-host.invalid:14551")
