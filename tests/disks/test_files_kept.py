"""Commands that write files leave the old file or the whole new one when the disk fails or they are killed, and say which."""

import os
import random
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.disks.file_commands import COMMANDS
from tests.forked import EndedCommand, Programs, failing_disk

pytestmark = pytest.mark.long

SEED = int(os.environ.get("DISKS_SEED", "0")) or time.time_ns() % 1_000_000  # printed; the variable repeats a run
QUICK = {"kill": 2, "full": 1, "gone": 1, "read-only": 1}  # calls at which `make test` fails each command
PAGE_BYTES = 4096
MANY = 40  # the same in `make test-slow`; all calls where there are fewer


@pytest.fixture(scope="module")
def programs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Programs]:
    with Programs(failing_disk(tmp_path_factory.mktemp("disk"))) as running:
        yield running


class DiskTrial:
    """One command: its files before, and what it writes on a good disk."""

    def __init__(self, name: str, programs: Programs, folder: Path) -> None:
        self.name, self.command, self._programs, self._folder = name, COMMANDS[name], programs, folder
        self._before, self._number = folder / "before", 0
        self._before.mkdir()
        self.command.before(self._before)
        self._old = self._contents(self._before)
        good = self._copy()
        self.undisturbed = programs.run(list(self.command.arguments), good)
        assert self.undisturbed.code == 0, self.undisturbed.output
        self._new = self._contents(good)
        same = [name for name, content in self._new.items() if content == self._old[name]]
        assert not same, f"{name} does not write {same}"
        self.folder = good

    def _copy(self) -> Path:
        self._number += 1
        return Path(shutil.copytree(self._before, self._folder / str(self._number)))

    def _contents(self, folder: Path) -> dict[str, bytes | None]:
        return {name: (folder / name).read_bytes() if (folder / name).exists() else None for name in self.command.written}

    def _is_new(self, name: str, data: bytes | None) -> bool:
        reference = self._new[name]
        assert reference is not None
        return data is not None and self.command.content(data) == self.command.content(reference)

    def succeeds(self, fault: str) -> None:
        """Run on a disk of another kind. Raises AssertionError if a file is lost."""
        folder = self._copy()
        ended = self._programs.run(list(self.command.arguments), folder, fault)
        assert ended.code == 0, ended.output
        assert all(self._is_new(name, data) for name, data in self._contents(folder).items()), ended.output
        self._check(folder, ended.output)
        again = self._programs.run(list(self.command.arguments), folder, fault)
        assert again.code == (2 if self.command.is_new else 0), again.output

    def survives_power_cut(self) -> None:
        """Check that a file's content is on the disk before the file gets its name, and the name before the command ends.
        Raises AssertionError."""
        unsynced, unnamed = set[str](), dict[str, str]()
        for line in self.undisturbed.trace:
            call, path, other = line.split("\t")
            if call in ("write", "truncate"):
                unsynced.add(path)
            elif call == "fsync":
                unsynced.discard(path)
                unnamed = {file: folder for file, folder in unnamed.items() if folder != path}
            elif call in ("rename", "exchange", "link"):
                assert path not in unsynced, f"{other}: has its name before its content is on the disk"
                unnamed[other] = str(Path(other).parent)
        written = {str(self.folder.resolve() / file) for file in self.command.written}
        assert not written & unsynced, "their content is not on the disk"
        assert not written & unnamed.keys(), "their names are not on the disk"

    def _check(self, folder: Path, ending: str) -> None:
        """Check files against one another, and look for the original."""
        self.command.check(folder)
        if self.command.keeps_old:
            contents = [file.read_bytes() for file in folder.rglob("*") if file.is_file()]
            assert self._old[self.command.written[0]] in contents, f"the original is lost: {ending}"

    def fails(self, fault: str, call: int) -> None:
        """Let the disk fail at a call. Raises AssertionError if a file is lost, or if the command says something else."""
        folder = self._copy()
        ended = self._programs.run(list(self.command.arguments), folder, fault, call)
        case = f"{self.name}: {fault} at call {call}"
        if fault == "kill":
            assert ended.code == -9 or (ended.code == 0 and ended.calls < call), f"{case}: {ended}"
        self._judge(case, ended, folder)
        self._repeat(case, folder)

    def is_removed(self, call: int) -> None:
        """Have a person delete all that is in the folder just before a call. Raises AssertionError if the command says that
        it has written what is not there, unless that was deleted behind the call which gave it its name."""
        folder = self._copy()
        ended = self._programs.run(list(self.command.arguments), folder, "removed", call)
        missing = {name for name, data in self._contents(folder).items() if data is None}
        case, ending = f"{self.name}: removed at call {call}", f"{ended.code}: {ended.output}"
        assert "Traceback" not in ended.output, f"{case}: {ending}"
        if not missing:
            assert ended.code == 0 or "is written" in ended.last_line, f"{case}: all is written: {ending}"
        elif any(call <= self._named_by(name) for name in missing):
            named = (*self.command.written, *_folders([*self.command.written]), *_files(self._before), folder.name)
            assert ended.code in (1, 2) and any(name in ended.last_line for name in named), (
                f"{case}: without {missing}: {ending}"
            )
        assert not missing or "is written" not in ended.output, f"{case}: without {missing}: {ending}"
        shutil.rmtree(folder)

    def _named_by(self, name: str) -> int:
        """Number of the undisturbed run's last call that gave a file its name."""
        place = self.folder.resolve() / name
        calls = enumerate((line.split("\t") for line in self.undisturbed.trace), 1)
        naming = ("rename", "exchange", "link")
        return max(number for number, (call, _, other) in calls if call in naming and place.is_relative_to(other))

    def fills(self, disk: Path, pages: int) -> None:
        """Run on a file system that has room for so many more pages. Raises AssertionError as `fails`."""
        folder, filler = Path(shutil.copytree(self._before, disk / "folder")), disk / "filler"
        room = shutil.disk_usage(disk).free - pages * PAGE_BYTES
        filler.write_bytes(bytes(room))
        case = f"{self.name}: {pages} pages free"
        self._judge(case, self._programs.run(list(self.command.arguments), folder), folder)
        filler.unlink()
        self._repeat(case, folder)

    def _judge(self, case: str, ended: EndedCommand, folder: Path) -> None:
        """Check the files, and what the command says of them."""
        now = self._contents(folder)
        new = {name for name, data in now.items() if data != self._old[name]}
        for name in new:
            try:
                assert self._is_new(name, now[name]), f"{case}: half of {name}, or something else\n{ended.output}"
            except ValueError as error:
                raise AssertionError(f"{case}: half of {name}: {error}\n{ended.output}") from error
        self._check(folder, f"{case}: {ended.output}")
        if ended.code != -9:
            self._says_which(case, ended, new, folder)

    def _repeat(self, case: str, folder: Path) -> None:
        """Run again on a good disk, if not all is written, and remove the folder."""
        if self._contents(folder).items() & self._old.items():
            after = self._programs.run(list(self.command.arguments), folder)
            assert after.code == 0, f"{case}: cannot be done again: {after.output}"
            assert all(self._is_new(name, data) for name, data in self._contents(folder).items()), f"{case}: {after.output}"
        shutil.rmtree(folder)

    def _says_which(self, case: str, ended: EndedCommand, new: set[str], folder: Path) -> None:
        """Check the exit code and the last line against the files."""
        assert "Traceback" not in ended.output, f"{case}: {ended.output}"
        if ended.code == 0:
            assert new == set(self.command.written), f"{case}: exit code 0, but not written: {self._new.keys() - new}"
            return
        assert ended.code in (1, 2), f"{case}: {ended}"
        missing = [name for name in self.command.written if name not in new]
        if not missing:
            assert "is written" in ended.last_line, f"{case}: exit code {ended.code}, but all is written: {ended.output}"
            return
        assert len(missing) == len(self.command.written) or any(name in ended.last_line for name in missing), (
            f"{case}: not written are {missing}, and it says {ended.last_line}"
        )
        named = (*missing, *_folders(missing), *_files(folder))  # one that is read may be what the disk does not give
        assert folder.name in ended.last_line or any(name in ended.last_line for name in named), (
            f"{case}: names no file: {ended.output}"
        )


def _files(folder: Path) -> list[str]:
    return [str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file()]


def _folders(names: list[str]) -> set[str]:
    return {name.split("/")[0] for name in names}


@pytest.mark.parametrize("name", COMMANDS)
def test_the_old_file_or_the_whole_new_one_is_there(name: str, programs: Programs, tmp_path: Path) -> None:
    chance = random.Random(f"{SEED} {name}")
    print(f"DISKS_SEED={SEED}")
    trial = DiskTrial(name, programs, tmp_path)
    if trial.command.survives_power_cut:
        trial.survives_power_cut()
    for fault, times in QUICK.items():
        for _ in range(times):
            trial.fails(fault, chance.randint(1, trial.undisturbed.calls))
    trial.is_removed(chance.randint(1, trial.undisturbed.calls))


@pytest.fixture(scope="module")
def small_disk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A file system of one megabyte."""
    folder = tmp_path_factory.mktemp("small")
    mounting = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(mounting, capture_output=True, check=False).returncode != 0:
        pytest.skip("no small disk may be mounted here")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


@pytest.mark.parametrize("name", ["repair", "export", "keys-add"])
def test_a_full_file_system_keeps_the_old_file(name: str, programs: Programs, small_disk: Path, tmp_path: Path) -> None:
    """The kernel's own errors, of a disk with room for a part of what is written."""
    chance = random.Random(f"{SEED} {name}")
    print(f"DISKS_SEED={SEED}")
    trial = DiskTrial(name, programs, tmp_path)
    for pages in (0, chance.randint(1, 12)):
        trial.fills(small_disk, pages)


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_it_is_there_whatever_call_fails(name: str, programs: Programs, tmp_path: Path) -> None:
    chance = random.Random(f"{SEED} {name}")
    print(f"DISKS_SEED={SEED}")
    trial = DiskTrial(name, programs, tmp_path)
    calls = range(1, trial.undisturbed.calls + 1)
    for fault in QUICK:
        for call in calls if len(calls) <= MANY else sorted(chance.sample(calls, MANY)):
            trial.fails(fault, call)


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_a_file_that_is_removed_meanwhile_is_not_called_written(name: str, programs: Programs, tmp_path: Path) -> None:
    trial = DiskTrial(name, programs, tmp_path)
    calls = range(1, trial.undisturbed.calls + 1)
    for call in calls if len(calls) <= MANY else sorted(random.Random(f"{SEED} {name}").sample(calls, MANY)):
        trial.is_removed(call)


@pytest.mark.parametrize("name", [name for name, command in COMMANDS.items() if command.keeps_old or command.is_new])
def test_a_disk_without_links_is_written_to(name: str, programs: Programs, tmp_path: Path) -> None:
    """A memory stick's file system."""
    DiskTrial(name, programs, tmp_path).succeeds("no-links")
