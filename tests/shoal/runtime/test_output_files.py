"""Files that commands write: whole or not at all, never through a link, never over what is read or a run's own."""

import errno
import os
import re
import resource
import secrets
import stat
from contextlib import suppress
from pathlib import Path

import pytest

from shoal.errors import ConfigError
from shoal.runtime.output_files import (
    CAMPAIGN,
    RUN,
    check_output,
    dated,
    replace_text,
    replacing,
    replacing_folder,
    run_folder,
)


def test_a_link_in_the_way_is_replaced_and_not_followed(tmp_path: Path) -> None:
    victim, link = tmp_path / "victim", tmp_path / "run" / "result.json"
    victim.write_text("precious")
    link.parent.mkdir()
    link.symlink_to(victim)
    replace_text(link, "new")
    assert (victim.read_text(), link.read_text(), link.is_symlink()) == ("precious", "new", False)


def test_an_error_leaves_only_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    path.write_text("old")
    with pytest.raises(ZeroDivisionError), replacing(path) as file:
        file.write(b"half")
        raise ZeroDivisionError
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_a_full_disk_leaves_the_old_file_and_names_it(tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    path.write_text("old")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(OSError, match="too large") as caught:
            replace_text(path, "x" * 5000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert caught.value.filename == str(path)
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_a_path_that_cannot_be_written_is_named_in_the_error(tmp_path: Path) -> None:
    for place, code in ((tmp_path, errno.EISDIR), (tmp_path / "none" / "file", errno.ENOENT)):
        with pytest.raises(OSError, match=re.escape(str(place))) as caught:
            replace_text(place, "")
        assert (caught.value.errno, caught.value.filename) == (code, str(place))


def test_rights_of_a_file_stay_as_they_were(tmp_path: Path) -> None:
    path = tmp_path / "file"
    replace_text(path, "one")
    path.chmod(0o600)
    replace_text(path, "two")
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_a_pipe_is_written_to(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        replace_text(pipe, "told")
        assert os.read(reader, 10) == b"told"
    finally:
        os.close(reader)
    replace_text(Path("/dev/null"), "nobody reads it")
    assert Path("/dev/null").is_char_device()


def test_an_output_that_is_a_file_to_append_to_keeps_what_is_there(tmp_path: Path) -> None:
    kept = tmp_path / "kept.txt"
    kept.write_text("a long day's results\n")
    with kept.open("a") as out:
        replace_text(Path(f"/dev/fd/{out.fileno()}"), "new\n")
    assert kept.read_text() == "a long day's results\nnew\n"


@pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="Linux's disk in memory")
def test_a_file_in_shared_memory_is_replaced_like_any_other() -> None:
    path = Path("/dev/shm") / f"{secrets.token_hex(8)}.toml"
    try:
        replace_text(path, "an earlier, longer text")
        with suppress(ValueError), replacing(path) as file:
            file.write(b"half")
            raise ValueError
        assert path.read_text() == "an earlier, longer text"
        replace_text(path, "new")
        assert path.read_text() == "new"
    finally:
        path.unlink(missing_ok=True)


def test_an_input_file_is_not_overwritten_by_any_name(tmp_path: Path) -> None:
    read, link, hard = tmp_path / "image.png", tmp_path / "link.png", tmp_path / "hard.png"
    read.touch()
    link.symlink_to(read)
    hard.hardlink_to(read)
    for out in (read, link, hard, tmp_path / "." / "image.png"):
        with pytest.raises(ConfigError, match="is read by this command"):
            check_output(out, [tmp_path / "none", read])
    check_output(tmp_path / "other.png", [read])


@pytest.mark.parametrize("name", RUN)
def test_a_runs_own_file_is_not_written_over_even_where_it_is_lost(tmp_path: Path, name: str) -> None:
    (tmp_path / ("experiment.toml" if name == "run.mcap" else "run.mcap")).touch()
    with pytest.raises(ConfigError, match="is a file of a run"):
        check_output(tmp_path / name)
    check_output(tmp_path / "figures.html")
    check_output(tmp_path.parent / "report.html")  # no folder of a run


def test_a_campaigns_folder_is_its_own(tmp_path: Path) -> None:
    (tmp_path / "journal.jsonl").touch()
    check_output(tmp_path / "report.html", mine=CAMPAIGN)
    with pytest.raises(ConfigError, match="is a file of a campaign"):
        check_output(tmp_path / "report.html")
    (tmp_path / "run.mcap").touch()
    with pytest.raises(ConfigError, match="is a file of a run"):
        check_output(tmp_path / "report.html", mine=CAMPAIGN)


def test_a_run_folder_stays_where_something_was_put_and_nowhere_else(tmp_path: Path) -> None:
    out = tmp_path / "runs" / "mine"
    with run_folder(out, "pool") as first, run_folder(out, "pool") as second:
        assert first != second and first.parent == out  # within a second
    assert not out.exists()
    with run_folder(out, "pool") as folder:
        (folder / "run.mcap").touch()
    with pytest.raises(ConfigError), run_folder(out, "pool"):
        raise ConfigError("refused")
    assert list(out.iterdir()) == [folder]


def test_an_earlier_file_is_kept_whole_where_there_are_no_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a USB stick's file system."""

    def refuse(name: Path, path: Path) -> None:
        raise OSError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr(Path, "hardlink_to", refuse)
    path = tmp_path / "lens.toml"
    path.write_text("the earlier lens")
    with replacing(path, keep=dated) as new:
        new.write(b"the new lens")
    (kept,) = (file for file in tmp_path.iterdir() if file != path)
    assert (path.read_text(), kept.read_text()) == ("the new lens", "the earlier lens")


def test_a_folder_that_replaced_another_leaves_nothing_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "pages"
    for text in ("old", "new"):
        with replacing_folder(path) as folder:
            (folder / "page.html").write_text(text)
    assert list(tmp_path.iterdir()) == [path]
    assert (path / "page.html").read_text() == "new"
