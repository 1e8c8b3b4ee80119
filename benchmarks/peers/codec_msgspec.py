"""msgspec: MessagePack with typed structs, about the fastest checked encoding that Python has a wheel for."""

import functools
import importlib
import json
import sys
from typing import Any

from benchmarks.harness import Row, time_us

msgspec: Any = importlib.import_module("msgspec")  # not in our environment, so neither are its types

KINDS = {"float": float, "int": int, "bool": bool, "str": str, "floats": list[float], "ints": list[int]}


def _rows(name: str, kinds: dict[str, str], values: dict[str, Any], calls: int) -> list[Row]:
    kind = msgspec.defstruct(name, [(field, KINDS[word]) for field, word in kinds.items()], frozen=True, array_like=True)
    message = kind(**{field: KINDS[kinds[field]](value) for field, value in values.items()})
    encode = functools.partial(msgspec.msgpack.Encoder().encode, message)
    decode = functools.partial(msgspec.msgpack.Decoder(kind).decode, encode())
    if decode() != message:
        raise SystemExit(f"{name} does not come back as it was sent")
    size = float(len(encode()))
    return [
        Row.of("codec", f"encode {name}", "msgspec, lists for arrays", "us", time_us(encode, calls)),
        Row.of("codec", f"decode {name}", "msgspec, lists for arrays", "us", time_us(decode, calls)),
        Row("codec", f"size of {name}", "msgspec, lists for arrays", "bytes", size, size, size, 1),
    ]


if __name__ == "__main__":
    task = json.load(sys.stdin)
    rows = [row for name, m in task["messages"].items() for row in _rows(name, m["kinds"], m["values"], task["calls"])]
    print(json.dumps([row.as_dict() for row in rows]))
