"""The folders in which a user's programs find each other: the same for every kind of login, and nobody else's."""

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from groundstation.gate import user_folders
from groundstation.gate.gate import doors_of, through_door
from groundstation.gate.user_folders import fits, is_private
from groundstation.gate.user_folders import user_folders as folders


@pytest.fixture(autouse=True)
def machine(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A machine's folders for all users, and no environment. Their paths are short enough for a socket."""
    for name in (user_folders.ONLY, "XDG_RUNTIME_DIR", "TMPDIR"):
        monkeypatch.delenv(name, raising=False)
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        machine = Path(folder)
        (machine / "run" / str(os.geteuid())).mkdir(parents=True)
        (machine / "tmp").mkdir()
        monkeypatch.setattr(user_folders, "RUN", machine / "run")
        monkeypatch.setattr(user_folders, "TEMPORARY", machine / "tmp")
        yield machine


@pytest.mark.parametrize(
    "station",
    [{}, {"XDG_RUNTIME_DIR": "{}/own"}, {"TMPDIR": "{}/own"}, {"XDG_RUNTIME_DIR": "own"}, {user_folders.ONLY: "{}/no"}],
)
@pytest.mark.parametrize("terminal", [{}, {"XDG_RUNTIME_DIR": "{}/other"}, {"TMPDIR": "{}/missing"}, {user_folders.ONLY: "x"}])
def test_each_login_looks_into_a_folder_of_each_other(
    machine: Path, monkeypatch: pytest.MonkeyPatch, station: dict[str, str], terminal: dict[str, str]
) -> None:
    def seen(environment: dict[str, str], make: bool) -> set[Path]:
        with monkeypatch.context() as patch:
            for name, value in environment.items():
                patch.setenv(name, value.format(machine))
            return set(folders(make))

    for name in ("own", "other"):
        (machine / name).mkdir()
    shared = seen(station, make=True) & seen(terminal, make=False)
    assert shared >= {machine / "run" / str(os.geteuid()) / "shoal", machine / "tmp" / f"shoal-{os.geteuid()}"}


def test_a_folder_that_others_may_enter_is_not_used(machine: Path) -> None:
    folder = machine / "tmp" / f"shoal-{os.geteuid()}"
    assert not is_private(folder)
    assert is_private(folder, make=True) and folder in folders()
    for mode in (0o701, 0o710, 0o770, 0o777):
        folder.chmod(mode)
        assert folder not in folders(make=True)
    folder.rmdir()
    (machine / "elsewhere").mkdir(mode=0o700)
    folder.symlink_to(machine / "elsewhere")
    assert not is_private(folder, make=True)


def test_one_folder_confines_and_counts_for_nothing_if_it_cannot_be_used(
    machine: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (machine / "lab").mkdir(mode=0o700)
    monkeypatch.setenv(user_folders.ONLY, str(machine / "lab"))
    assert folders(make=True) == (machine / "lab",)
    (machine / "lab").chmod(0o755)
    assert len(folders(make=True)) == 2


def test_a_socket_has_a_short_path() -> None:
    assert fits(Path("/" + 99 * "a")) and not fits(Path("/" + 100 * "a"))


def test_a_look_for_a_door_makes_no_folder(machine: Path) -> None:
    before = sorted(machine.rglob("*"))
    assert folders() == () and doors_of(7447) == [] and through_door("tls/127.0.0.1:7447") is None
    assert sorted(machine.rglob("*")) == before
    assert len(doors_of(7447, make=True)) == 2 and sorted(machine.rglob("*")) != before
