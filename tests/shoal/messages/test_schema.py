"""Messages keep the bytes that they have: field numbers and widths in the dataclasses give the same protobuf as ever.

`python -m tests.shoal.messages.test_schema` writes the golden bytes again, after a change that is meant.
"""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import pytest

from shoal.messages import codec, messages, schema
from shoal.messages.codec import encode
from shoal.messages.messages import Uint32
from tests.shoal.strategies import OWN, example, same

GOLDEN = Path(__file__).with_name("golden_bytes.json")

each_class = pytest.mark.parametrize("cls", OWN, ids=lambda cls: cls.__name__)


def _golden() -> dict[str, str]:
    golden: dict[str, str] = json.loads(GOLDEN.read_text())
    return golden


def test_there_are_golden_bytes_of_every_message() -> None:
    assert sorted(_golden()) == sorted(cls.__name__ for cls in OWN)


@each_class
def test_a_message_has_the_bytes_it_always_had(cls: Any) -> None:
    """They change only where somebody means to change the wire."""
    assert encode(example(cls)).hex() == _golden()[cls.__name__]


@each_class
def test_the_bytes_it_always_had_are_read(cls: Any) -> None:
    assert same(codec.decode(cls, bytes.fromhex(_golden()[cls.__name__]), "peer", "topic"), example(cls))


def test_enums_have_the_values_of_the_dataclasses() -> None:
    enums = {described.name: described for described in schema.file_descriptor("fleet", codec.OWN).enum_type}
    camera = {value.name: value.number for value in enums["CameraHealth"].value}
    assert camera == {f"CAMERA_HEALTH_{member.name}": member.value for member in messages.CameraHealth}
    assert set(enums) == {"Track", "Mode", "Guidance", "Solve", "CommandKind", "Progress", "CameraHealth"}


def test_a_part_that_has_to_be_there_is_asked_for() -> None:
    assert messages.required("") == "" and messages.required(0) == 0
    with pytest.raises(ValueError, match="the message has no such part"):
        messages.required(None)


@dataclass(frozen=True)
class _Numberless:
    depth_m: float = 0.0


@dataclass(frozen=True)
class _Widthless:
    count: Annotated[int, 1] = 0


@dataclass(frozen=True)
class _TwoOfOneNumber:
    one: Annotated[Uint32, 1] = 0
    other: Annotated[tuple[Uint32, ...], 1] = field(default=())


@pytest.mark.parametrize("cls", [_Numberless, _Widthless, _TwoOfOneNumber])
def test_a_field_without_a_number_or_width_of_its_own_is_refused(cls: Any) -> None:
    """At import, not when the first robot sends it."""
    with pytest.raises((TypeError, KeyError)):
        schema.message_classes("test", (cls,))


if __name__ == "__main__":
    GOLDEN.write_text(json.dumps({cls.__name__: encode(example(cls)).hex() for cls in OWN}, indent=1) + "\n")
