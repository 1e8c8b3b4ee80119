"""SHELL: the file that a setup changes: the experiment, or the camera file that it names. Comments and order are kept.

It is read once, its changes are shown as a difference, and it is written only when asked for, only if it is as it was read,
and with the old one kept beside it.
"""

import difflib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import tomlkit

from shoal.config.experiment import EXPERIMENTS, NO_CAMERA, Experiment, checked_experiment, load_experiment
from shoal.config.loader import MOST_BYTES, check, read_toml
from shoal.config.perception import Camera, CameraFile
from shoal.errors import ConfigError, os_errors_as_config_errors
from shoal.runtime.output_files import dated, replacing
from shoal.system.regular_files import read_regular

_WIDE = 127  # of a line; longer lists are broken


class ExperimentFile:
    """The file that holds the table [camera] of an experiment."""

    def __init__(self, experiment: Path, out: Path | None) -> None:
        """`out`: a new file for the changed experiment, needed for one that is shipped. Raises ConfigError."""
        if out is None and experiment.resolve().parent == EXPERIMENTS.resolve():
            raise ConfigError(
                f"{experiment.stem}: a shipped experiment is not changed (give a new file: --out {experiment.name})"
            )
        if out is not None and out.exists():
            raise ConfigError(f"--out {out}: is there already (set it up itself: localizer setup {out})")
        if out is not None and (out.suffix != ".toml" or not out.parent.is_dir()):
            raise ConfigError(f"--out {out}: must end in .toml, in a folder that exists")
        self._experiment, self._out = experiment, out
        table = read_toml(experiment)
        if "cameras" in table:
            raise ConfigError(
                f"{experiment}: has several cameras, and a setup is of one (allowed: for each an experiment with [camera]; "
                "then [[cameras]] takes the saved files: docs/calibration.md)"
            )
        camera = table.get("camera")
        if out is not None:  # files that the experiment names have to be there from its new place too
            loaded = load_experiment(str(experiment), () if "camera" in table else [NO_CAMERA])
            checked_experiment(table | {"camera": loaded.camera.model_dump(mode="json")}, out)
        self._camera_file = experiment.parent / camera if isinstance(camera, str) and out is None else None
        self.reload()

    @property
    def path(self) -> Path:
        """The file that will be written."""
        return self._camera_file or self._out or self._experiment

    @property
    def has_camera(self) -> bool:
        """False if the file has no camera yet: all its keys come from the setup."""
        return self._has_camera(self._text)

    def _has_camera(self, text: str) -> bool:
        return self._camera_file is not None or "camera" in tomlkit.parse(text)

    def reload(self) -> None:
        """Read the file again; changes are then shown against what it holds now. Raises ConfigError, and goes on with what it
        held, if it is no experiment's now."""
        with os_errors_as_config_errors(self._source):
            text = self._read()
        self._camera_of(text)
        self._text = text

    def _read(self) -> str:
        try:
            text = read_regular(self._source, MOST_BYTES).decode("utf-8-sig")
            tomlkit.parse(text)
        except ValueError as error:
            raise ConfigError(f"{self._source}: {error}") from None
        return text

    @property
    def camera(self) -> Camera:
        """The camera that the file holds. Raises ConfigError if the file is no longer one of an experiment."""
        return self._camera_of(self._text)

    def _camera_of(self, text: str) -> Camera:
        return self._checked(tomlkit.parse(text).unwrap(), () if self._has_camera(text) else [NO_CAMERA]).camera

    @property
    def _source(self) -> Path:
        return self._camera_file or self._experiment

    def changed(self, camera: Mapping[str, Any]) -> str:
        """The file's text with these values of [camera]. Raises ConfigError if no experiment would come of it."""
        document = tomlkit.parse(self._text)
        table: Any = document.get("camera")
        if isinstance(table, str):  # a copy of an experiment whose camera is in a file: it gets the file's table
            inserted = read_toml(self._experiment.parent / table)["camera"]
            document.remove("camera")
            table = tomlkit.table()
            table.update(inserted)
            document.append("camera", table)
        elif table is None:
            table = tomlkit.table()
            document.append("camera", table)
        for key, value in camera.items():
            if table.get(key) != value:
                table[key] = _item(key, value)
        text = tomlkit.dumps(document)
        self._checked(tomlkit.parse(text).unwrap())
        return text

    def _checked(self, table: dict[str, Any], settings: Sequence[str] = ()) -> Experiment:
        if self._camera_file is not None:
            camera_table = check(CameraFile, table, str(self._camera_file)).camera.model_dump(mode="json")
            table = read_toml(self._experiment) | {"camera": camera_table}
        return checked_experiment(table, self._experiment, settings)

    def difference(self, camera: Mapping[str, Any]) -> list[str]:
        """Lines of the difference that saving would make, as `diff -u` tells it. Raises ConfigError."""
        before, after = self._text.splitlines(), self.changed(camera).splitlines()
        return list(difflib.unified_diff(before, after, str(self._source), str(self.path), n=2, lineterm=""))

    def save(self, camera: Mapping[str, Any]) -> str:
        """Write the changed file, and the old one beside it; returns what was written, in words. Raises ConfigError, and has
        then written nothing in its place."""
        text, path = self.changed(camera), self.path
        with os_errors_as_config_errors(path):
            if path == self._source and self._read() != self._text:
                raise ConfigError(
                    f"{path}: was changed by somebody else since it was read; read it again, and look at the difference"
                )
            if path != self._source and path.exists():
                raise ConfigError(f"{path}: is there already, and was not written by this program")
            with replacing(path, keep=dated) as new:
                new.write(text.encode())
        kept = "" if new.kept is None else f"; the old file is {new.kept}"
        if self._camera_file is None:
            self._experiment, self._out = path, None
        self._text = text
        return f"wrote {path}{kept}"


def _item(key: str, value: Any) -> Any:
    """A value in tomlkit's form; a long list is broken into lines."""
    item = tomlkit.item(value)
    if isinstance(value, list) and len(f"{key} = {item.as_string()}") > _WIDE:
        item.multiline(True)
    return item
