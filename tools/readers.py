"""Modules that read each key of an experiment or a vehicle, found in the source: a module that takes the key's attribute, and
names the key's section or its class."""

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from pydantic import BaseModel

from shoal.config.key_reference import ROOTS
from shoal.config.loader import sections_of

ROOT = Path(__file__).parents[1]
PROGRAMS = ("localizer", "robot_agent", "groundstation", "sim_bridge", "shoal")
WORD = re.compile(r"(\.?)\b([A-Za-z_]\w*)")
TEXT = re.compile(r'""".*?"""', re.DOTALL)


@cache
def _words() -> dict[str, tuple[frozenset[str], frozenset[str]]]:
    """For each module its attributes, and all its words."""
    words_by_module = {}
    for package in PROGRAMS:
        for path in sorted((ROOT / package).rglob("*.py")):
            words = WORD.findall(TEXT.sub("", path.read_text(encoding="utf-8")))
            words_by_module[str(path.relative_to(ROOT))] = (
                frozenset(word for dot, word in words if dot),
                frozenset(word for _, word in words),
            )
    return words_by_module


def _sections(model: type[BaseModel], name: str) -> Iterator[tuple[type[BaseModel], str]]:
    """The models below a model, each with the name of its field."""
    yield model, name
    for field, info in model.model_fields.items():
        for section in sections_of(info.annotation):
            yield from _sections(section, field)


@cache
def _owners() -> dict[str, dict[str, set[str]]]:
    """For each dotted section the words by which code reaches it, and for each of its keys the words of its class."""
    owners: dict[str, dict[str, set[str]]] = {}
    for root in ROOTS.values():
        for model, name in _sections(root, ""):
            for field in model.model_fields:
                owners.setdefault(name, {}).setdefault(field, set()).update({model.__name__, name} - {""})
    return owners


def readers(name: str) -> list[str]:
    """Modules that read a dotted key of the reference, `N` for an index. The files' checks count only if no other does."""
    *above, key = [part for part in name.split(".") if part != "N"]
    words = _owners().get(above[-1] if above else "", {}).get(key, set())
    strict: list[str] = []
    loose: list[str] = []
    for module, (attributes, every) in _words().items():
        if key in attributes:
            (strict if words & every else loose).append(module)
        elif key in every and words & every and "/config/" not in module:  # by `getattr`
            loose.append(module)
    programs = [m for m in strict if "/config/" not in m]
    return programs or strict or loose
