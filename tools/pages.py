"""SHELL: every generated page of docs/ and the schemas of editors, written from the sources: `make docs`."""

from pathlib import Path

from tools import evidence, keys, laws, messages, proto, tables, typescript

GENERATORS = (keys, messages, proto, tables, typescript, evidence, laws)


def files() -> dict[Path, str]:
    """Every generated file and its text."""
    return {path: text for generator in GENERATORS for path, text in generator.files().items()}


if __name__ == "__main__":
    for path, text in files().items():
        path.parent.mkdir(exist_ok=True)
        path.write_text(text, encoding="utf-8")
