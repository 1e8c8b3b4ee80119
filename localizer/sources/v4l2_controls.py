"""The controls that a V4L2 camera offers (gain, focus, white balance ...), with their ranges, through linuxpy.

They are set on a file descriptor of their own, so that a source may stream meanwhile. Names are those of `v4l2-ctl`.
"""

import importlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

from shoal.errors import ConfigError

EXPOSURES = ("exposure_time_absolute", "exposure_absolute")  # newer kernels, older ones
EXPOSURE_UNIT_S = 1e-4  # V4L2_CID_EXPOSURE_ABSOLUTE counts in 100 us


@dataclass(frozen=True)
class CameraControl:
    """One control. `choices` names the values of a menu; `usable` is False while another control rules it, as automatic
    exposure does the exposure."""

    name: str
    value: int
    minimum: int
    maximum: int
    step: int
    default: int
    choices: tuple[tuple[int, str], ...] = ()
    usable: bool = True

    def checked(self, value: int) -> int:
        """The value. Raises ConfigError, naming what is allowed, if the control does not have it."""
        named = [number for number, _ in self.choices]
        if named and value not in named:
            raise ConfigError(f"camera.controls.{self.name} = {value}: not offered (allowed: {', '.join(map(str, named))})")
        if not self.minimum <= value <= self.maximum or (value - self.minimum) % max(self.step, 1):
            steps = f" in steps of {self.step}" if self.step > 1 else ""
            raise ConfigError(
                f"camera.controls.{self.name} = {value}: not offered (allowed: {self.minimum} to {self.maximum}{steps})"
            )
        return value


class CameraControls(Protocol):
    def offered(self) -> tuple[CameraControl, ...]:
        """All that can be set, with the present values. Raises ConfigError when the camera cannot be asked."""

    def set(self, name: str, value: int) -> None:
        """Set one. Raises ConfigError when there is none of that name, the value is not allowed, or the camera refuses."""


class V4l2Controls:
    """The controls of a device such as /dev/video0."""

    def __init__(self, device: str) -> None:
        self._device = device

    def offered(self) -> tuple[CameraControl, ...]:
        with self._opened() as camera:
            return tuple(_control(control) for control in camera.controls.values() if _is_number(control))

    def set(self, name: str, value: int) -> None:
        """See CameraControls."""
        with self._opened() as camera:
            controls = {control.config_name: control for control in camera.controls.values() if _is_number(control)}
            if name not in controls:
                names = ", ".join(controls) or "none"
                raise ConfigError(f"camera.controls.{name}: {self._device} has none (allowed: {names})")
            try:
                controls[name].value = _control(controls[name]).checked(value)
            except AttributeError as error:  # linuxpy's, for a control that another one rules
                raise ConfigError(f"camera.controls.{name} = {value}: {self._device} refuses it: {error}") from None

    @contextmanager
    def _opened(self) -> Iterator[Any]:
        try:
            with importlib.import_module("linuxpy.video.device").Device(self._device) as camera:
                yield camera
        except (ImportError, OSError) as error:
            raise ConfigError(f"controls of {self._device}: {error}") from None


def set_all(controls: CameraControls, values: Mapping[str, int]) -> list[str]:
    """Set a camera's controls; returns the reasons for those that it did not take."""
    refused = []
    for name, value in values.items():
        try:
            controls.set(name, value)
        except ConfigError as error:
            refused.append(str(error))
    return refused


def _is_number(control: Any) -> bool:
    """True for numbers, switches and menus that may be read and written; False for buttons and what has no one value."""
    kinds = ("INTEGER", "BOOLEAN", "MENU", "INTEGER_MENU")
    flags = ("is_flagged_disabled", "is_flagged_read_only", "is_flagged_write_only")
    return control.type.name in kinds and not any(getattr(control, flag) for flag in flags)


def _control(control: Any) -> CameraControl:
    """A control of linuxpy as the setup page gets it."""
    info = control._info  # linuxpy hides a switch's default and range
    choices = tuple((int(k), str(v)) for k, v in control.data.items()) if hasattr(control, "data") else ()
    return CameraControl(
        control.config_name, int(control.value), info.minimum, info.maximum, max(info.step, 1), info.default_value, choices,
        usable=not control.is_flagged_inactive,
    )  # fmt: skip
