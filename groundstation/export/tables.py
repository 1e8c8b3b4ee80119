"""SHELL: a run's messages as tables of plain numbers with named units, for users without a reader of MCAP.

One table per topic and robot, a row per message in the order of arrival; of what is a list itself (the truth of all robots, a
plan's nodes, a trajectory's samples, obstacles, gains) a row per entry. Every recorded topic has its table; of pictures it
holds the sizes. Fields of a message within a message have its name and a dot before theirs. docs/runs.md says more.
"""

import csv
import dataclasses
import importlib
import io
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import IO, Any, Protocol, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from groundstation.analysis.alignment import zero_ns
from groundstation.formation_clock import clock_reading
from groundstation.logs.reader import LogMessage, read_log, valid_messages
from groundstation.logs.run_folders import read_json
from shoal.config.experiment import load_experiment
from shoal.errors import ConfigError
from shoal.messages import messages, topics
from shoal.messages.codec import DecodeError, decode
from shoal.messages.labels import labels
from shoal.messages.schema import nested_message, present_type
from shoal.messages.session_clocks import SessionClocks
from shoal.messages.topics import Topic
from shoal.runtime import runtime
from shoal.runtime.output_files import RUN, check_output, replacing_together

NOTHING = np.zeros(0)
AT_ONCE = 5_000  # rows that are kept until they are written: a few MB

# Messages that are lists: what a row's own column is called, and the field that fills it; "": rows are numbered from 0.
LISTS: dict[type, tuple[str, str]] = {
    messages.Truth: ("robot", "robots"),
    messages.Obstacles: ("obstacle", "ids"),
    messages.Plan: ("node", ""),
    messages.Trajectory: ("sample", ""),
    messages.Tuning: ("key", "keys"),
}


@dataclass(frozen=True)
class TableColumn:
    """A column of a table: its name, the type of its cells (float, int, bool, str), and a cell of a message and a row of it;
    None where there is nothing."""

    name: str
    kind: type
    cell: Callable[[Any, int], Any]


@dataclass
class Exported:
    """Files written, and trouble found."""

    files: list[tuple[Path, int]] = field(default_factory=list)  # with their rows
    trouble: str = ""  # what is wrong with the log as a whole
    undecodable: int = 0  # messages that are in no table


def export(run: Path, folder: Path, parquet: bool) -> Exported:
    """Write all tables of a run's log. Raises ConfigError if Parquet cannot be written, for a log without messages, and for a
    folder where a table would take the place of a run's file."""
    log, kind = run / "run.mcap", _parquet() if parquet else _CsvFile
    zero, trouble = _zero(log)
    folder.mkdir(parents=True, exist_ok=True)
    exported, open_tables = Exported(trouble=trouble), dict[tuple[Topic, int], _Table]()
    with replacing_together() as opened:

        def table(topic: Topic, robot: int) -> _Table:
            if (topic, robot) not in open_tables:
                name = topic.name.replace("/{robot}", f"-{robot}").replace("/", "-")
                path = folder / f"{name}{'.parquet' if parquet else '.csv'}"
                check_output(path, [run / own for own in RUN])
                open_tables[topic, robot] = _Table(topic, path, opened(path), zero, kind)
            return open_tables[topic, robot]

        for line in valid_messages(log):
            if not line.topic.recorded:
                continue
            try:
                message: Any = decode(line.topic.type, line.payload, "log", line.topic.name)
            except DecodeError:
                exported.undecodable += 1
                continue
            table(line.topic, line.robot).add(message, line)
        for finished in open_tables.values():
            finished.close()
    exported.files = [(t.path, t.rows) for _, t in sorted(open_tables.items(), key=lambda item: (item[0][0].name, item[0][1]))]
    return exported


def table(log: Path, topic: Topic, robot: int = 0) -> dict[str, NDArray[Any]]:
    """One table of a log in memory: its columns by name. Numbers that are not there are NaN, other cells None. Messages that
    cannot be decoded are left out; what is wrong with the log as a whole is a warning. Raises ConfigError for a log without
    messages."""
    zero, trouble = _zero(log)
    if trouble:
        runtime.log.warning("%s: %s", log, trouble)
    named = columns(topic.type)
    lines: list[list[Any]] = []
    for line in valid_messages(log):
        if line.topic is topic and line.robot == robot:
            with suppress(DecodeError):
                lines += _rows(decode(topic.type, line.payload, "log", topic.name), line, zero, named)
    table_columns = {}
    for k, (name, kind) in enumerate([*WHEN, *((column.name, column.kind) for column in named)]):
        cells = [line[k] for line in lines]
        whole = None not in cells
        dtype: Any = {float: np.float64, int: np.int64 if whole else np.float64, bool: np.bool_ if whole else object}.get(
            kind, object
        )
        table_columns[name] = np.array(cells, dtype=dtype)
    return table_columns


CLOCKS = (topics.STATE, topics.TRAJECTORY, topics.HEARTBEAT, topics.LOCALIZER)  # topics by which time 0 is found


@dataclass(frozen=True)
class _Zero:
    """The instant at which time_s is 0, on the recorder's clock, and the senders' clocks against that."""

    at_ns: int
    clocks: SessionClocks

    def since_s(self, line: LogMessage) -> float:
        header = line.header
        return (header.stamp_ns + self.clocks.shift_ns(line.topic.name, header.session, header.stamp_ns) - self.at_ns) * 1e-9


def _zero(log: Path) -> tuple[_Zero, str]:
    """Time 0, and what is wrong with the log as a whole. Raises ConfigError for an empty one."""
    states, file = read_log(log, CLOCKS, _clock_part), log.parent / "experiment.toml"
    if not states.messages:
        raise ConfigError(f"{log}: holds no messages")
    robots = load_experiment(str(file)).robot_ids if file.exists() else ()
    at_ns = zero_ns(states, robots or sorted({robot for _, robot in states.entries if robot}), _reported(log.parent))
    return _Zero(at_ns, states.clocks), states.trouble


def _reported(run: Path) -> int:
    """Number of the flight that a run's report is about; 0 where there is none."""
    flight = read_json(run / "result.json").get("flight")
    return flight if isinstance(flight, int) else 0


def _clock_part(message: Any) -> Any:
    """The part of a message that time 0 is counted from: a log of hours does not fit into memory as a whole."""
    if isinstance(message, messages.RobotState):
        return clock_reading(message)
    if isinstance(message, messages.LocalizerStatus):
        return None
    return messages.Trajectory(message.id, message.period_s) if isinstance(message, messages.Trajectory) else message


def _rows(message: Any, line: LogMessage, zero: _Zero, columns: Sequence[TableColumn]) -> Iterator[list[Any]]:
    """The rows of a message, with the time first."""
    stamp_ns, session = line.header.stamp_ns, f"{line.header.session:x}"
    when = [zero.since_s(line), stamp_ns, line.arrived_ns, session, line.header.sequence]
    for row in range(rows(message)):
        yield [*when, *(column.cell(message, row) for column in columns)]


# --- columns


def columns(cls: type, prefix: str = "") -> list[TableColumn]:
    """The columns of a message's table; with a prefix, of a message within another one."""
    listed, filled_by = ("", "") if prefix else LISTS.get(cls, ("", ""))
    entries: list[TableColumn] = []
    if listed:
        kind = int if filled_by != "keys" else str
        entries.append(TableColumn(listed, kind, _entry(filled_by) if filled_by else lambda m, row: row))
    if listed and cls is messages.Plan:
        entries.append(TableColumn("ahead_s", float, lambda m, row: row * m.period_s))
    if listed and cls is messages.Trajectory:
        entries.append(TableColumn("trajectory_s", float, lambda m, row: m.begin_s + row * m.period_s))
    hints = get_type_hints(cls)
    for f in dataclasses.fields(cls):
        if f.name != filled_by or not listed:
            entries += _field_columns(cls, f.name, hints[f.name], f.metadata.get("shape"), prefix, bool(listed))
    return entries


def rows(message: Any) -> int:
    """Number of rows of a message; an empty list has one row, which says so."""
    if type(message) not in LISTS:
        return 1
    lists = [getattr(message, f.name) for f in dataclasses.fields(message)]
    return max([1, *(len(value) for value in lists if isinstance(value, np.ndarray | tuple))])


def _field_columns(cls: type, name: str, hint: Any, shape: Any, prefix: str, listed: bool) -> list[TableColumn]:
    """Columns of a message's field: one for a value, one for each number of an array."""
    label = labels(cls).get(name)
    names = label.columns if label is not None and label.parts else None
    column = f"{prefix}{name}"

    def of_value(shown: Callable[[Any], Any]) -> Callable[[Any, int], Any]:
        """A cell made from the field's value, the same in each row."""
        return lambda message, row: shown(getattr(message, name))

    if shape is not None and -1 in shape and not listed:  # a list within a message
        if cls is messages.Trajectory:  # it has a table of its own
            return [TableColumn(f"{column}_samples", int, of_value(len))]
        return [TableColumn(column, str, of_value(lambda values: json.dumps(values.tolist())))]
    if shape is not None:
        if names is None:
            names = tuple(f"{name}_{k}" for k in range(int(np.prod([n for n in shape if n != -1]))))
        return [TableColumn(prefix + part, float, _cell_reader(name, k, -1 in shape)) for k, part in enumerate(names)]
    if names is not None:
        return [TableColumn(prefix + part, int, _entry(name, k)) for k, part in enumerate(names)]
    if get_origin(hint) is tuple:
        return [TableColumn(column, str, _text(name))]
    nested = nested_message(hint)
    if nested is not None:
        return [TableColumn(c.name, c.kind, _within(name, c)) for c in columns(nested, f"{column}.")]
    if isinstance(hint, type) and issubclass(hint, IntEnum):
        return [TableColumn(column, str, of_value(lambda value: value.name))]
    if hint is bytes:
        return [TableColumn(f"{column}_bytes", int, of_value(len))]
    if name.endswith("session") or name == "recipient":  # 64 bits without a sign
        return [TableColumn(column, str, of_value(lambda value: f"{value:x}"))]
    kind = present_type(hint)
    return [TableColumn(column, kind if kind in (float, int, bool) else str, of_value(lambda value: value))]


def _cell_reader(name: str, k: int, of_row: bool) -> Callable[[Any, int], Any]:
    """The function that reads number `k` of an array field as a cell, of a row of the array or of all of it."""

    def cell(message: Any, row: int) -> Any:
        values = getattr(message, name)
        if of_row:
            values = values[row] if row < len(values) else NOTHING
        return float(values.flat[k]) if k < values.size else None

    return cell


def _entry(name: str, k: int | None = None) -> Callable[[Any, int], Any]:
    """A function from a message and a row to an entry of the message's list `name`: the `k`-th one, or the row's own."""

    def cell(message: Any, row: int) -> Any:
        values, place = getattr(message, name), row if k is None else k
        return values[place] if place < len(values) else None

    return cell


def _text(name: str) -> Callable[[Any, int], Any]:
    """A list of any length in one cell, with spaces; sessions as everywhere in hexadecimal digits."""

    def cell(message: Any, row: int) -> Any:
        return " ".join(f"{value:x}" if name.endswith("sessions") else str(value) for value in getattr(message, name))

    return cell


def _within(name: str, column: TableColumn) -> Callable[[Any, int], Any]:
    """A function from a message and a row to a column's cell in the message's part `name`; None without that part."""

    def cell(message: Any, row: int) -> Any:
        inner = getattr(message, name)
        return None if inner is None else column.cell(inner, row)

    return cell


# --- files


class _RowFile(Protocol):
    """A kind of file that takes rows."""

    def __init__(self, file: IO[bytes], columns: Sequence[tuple[str, type]]) -> None: ...
    def write(self, rows: Sequence[Sequence[Any]]) -> None: ...
    def close(self) -> None: ...


WHEN = (("time_s", float), ("stamp_ns", int), ("arrived_ns", int), ("session", str), ("sequence", int))


class _Table:
    """One table, in an open file."""

    def __init__(self, topic: Topic, path: Path, file: IO[bytes], zero: _Zero, kind: type[_RowFile]) -> None:
        self.path, self.rows = path, 0
        self._columns, self._zero = columns(topic.type), zero
        self._file = kind(file, [*WHEN, *((c.name, c.kind) for c in self._columns)])
        self._waiting: list[list[Any]] = []

    def close(self) -> None:
        """Write the last rows, and the table's end."""
        self._write()
        self._file.close()

    def add(self, message: Any, line: LogMessage) -> None:
        """Add a message's rows."""
        for cells in _rows(message, line, self._zero, self._columns):
            self._waiting.append(cells)
            self.rows += 1
        if len(self._waiting) >= AT_ONCE:
            self._write()

    def _write(self) -> None:
        self._file.write(self._waiting)
        self._waiting = []


class _CsvFile:
    """Comma-separated values, the names of the columns first; what is not there is an empty cell."""

    def __init__(self, file: IO[bytes], columns: Sequence[tuple[str, type]]) -> None:
        self._text = io.TextIOWrapper(file, encoding="utf-8", newline="")
        self._writer = csv.writer(self._text)
        self._writer.writerow([name for name, _ in columns])

    def write(self, rows: Sequence[Sequence[Any]]) -> None:
        self._writer.writerows(rows)

    def close(self) -> None:
        self._text.flush()
        self._text.detach()


def _parquet() -> type[_RowFile]:
    """Parquet files. Raises ConfigError where the package is not installed."""
    try:
        arrow, files = importlib.import_module("pyarrow"), importlib.import_module("pyarrow.parquet")
    except ModuleNotFoundError:
        raise ConfigError("--parquet: not installed here (pip install pyarrow, or leave --parquet out for CSV)") from None
    types = {float: arrow.float64(), int: arrow.int64(), bool: arrow.bool_(), str: arrow.string()}

    class ParquetFile:
        def __init__(self, file: IO[bytes], columns: Sequence[tuple[str, type]]) -> None:
            self._schema = arrow.schema([(name, types[kind]) for name, kind in columns])
            self._writer = files.ParquetWriter(file, self._schema)

        def write(self, rows: Sequence[Sequence[Any]]) -> None:
            try:
                cells = zip(zip(*rows, strict=True), self._schema, strict=True) if rows else ()
                arrays = [arrow.array(column, of.type) for column, of in cells]
            except OverflowError:
                raise ConfigError("--parquet: the log holds a number of more than 63 bits (CSV takes it)") from None
            if arrays:
                self._writer.write_table(arrow.Table.from_arrays(arrays, schema=self._schema))

        def close(self) -> None:
            self._writer.close()

    return ParquetFile
