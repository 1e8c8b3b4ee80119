"""SHELL: a run's messages as tables of plain numbers, for whoever has no reader of MCAP."""

import csv
import dataclasses
import importlib
from collections.abc import Iterator, Mapping, Sequence
from enum import IntEnum
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from groundstation.runlog import Entry, read_log
from wire.toml_file import ConfigError

MOST_COLUMNS = 200  # a message with more numbers (a whole trajectory) is a table of its own, a row per sample


def export(log: Path, folder: Path, parquet: bool) -> Iterator[tuple[Path, int]]:
    """Write all tables of a log; yields each file with its number of rows. Raises ConfigError if Parquet cannot be
    written, and for a log that is empty."""
    write = _parquet() if parquet else _write_csv
    found = read_log(log).entries
    if not found:
        raise ConfigError(f"{log}: holds no messages")
    folder.mkdir(parents=True, exist_ok=True)
    for (topic, robot), entries in sorted(found.items()):
        name = topic.replace("/{robot}", f"-{robot}" if robot else "").replace("/", "-")
        path = folder / f"{name}{'.parquet' if parquet else '.csv'}"
        rows = [row for entry in entries for row in _rows(entry)]
        write(path, rows)
        yield path, len(rows)


def _rows(entry: Entry[Any]) -> list[dict[str, Any]]:
    """One row of columns; several if the message is a table itself."""
    when = {"stamp_s": entry.stamp_ns * 1e-9, "arrived_s": entry.arrived_ns * 1e-9, "sequence": entry.sequence}
    columns: dict[str, Any] = {}
    long: dict[str, Any] = {}
    for field in dataclasses.fields(entry.message):
        value = getattr(entry.message, field.name)
        if isinstance(value, np.ndarray) and value.ndim == 2 and value.size > MOST_COLUMNS:
            long |= {f"{field.name}_{i}": value[:, i].tolist() for i in range(value.shape[1])}
        else:
            columns |= _columns(field.name, value)
    if not long:
        return [when | columns]
    return [
        when | columns | {"sample": i} | dict(zip(long, row, strict=True)) for i, row in enumerate(zip_longest(*long.values()))
    ]


def _columns(name: str, value: Any) -> dict[str, Any]:
    if isinstance(value, IntEnum):
        return {name: value.name}
    if isinstance(value, np.ndarray):
        value = value.ravel().tolist()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {
            k: cell
            for f in dataclasses.fields(value)
            for k, cell in _columns(f"{name}_{f.name}", getattr(value, f.name)).items()
        }
    if isinstance(value, Mapping):
        value = list(value.values())
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return {key: cell for i, entry in enumerate(value) for key, cell in _columns(f"{name}_{i}", entry).items()}
    return {name: value.hex() if isinstance(value, bytes) else value}


def _names(rows: Sequence[dict[str, Any]]) -> list[str]:
    return list(dict.fromkeys(name for row in rows for name in row))


def _write_csv(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, _names(rows))
        writer.writeheader()
        writer.writerows(rows)


def _parquet() -> Any:
    try:
        arrow, files = importlib.import_module("pyarrow"), importlib.import_module("pyarrow.parquet")
    except ModuleNotFoundError:
        raise ConfigError("--parquet: not installed here (pip install pyarrow, or leave --parquet out for CSV)") from None

    def write(path: Path, rows: Sequence[dict[str, Any]]) -> None:
        files.write_table(arrow.table({name: [row.get(name) for row in rows] for name in _names(rows)}), path)

    return write
