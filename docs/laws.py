"""SHELL: docs/images/laws-*.png from the folders of comparisons: `python docs/laws.py NUMERIC_DISTURBED NUMERIC`."""

import sys
from pathlib import Path

import matplotlib as mpl

from groundstation.comparison import errors, wanted
from groundstation.plotting import STYLE
from wire.comparison import Comparison

IMAGES = Path(__file__).parent / "images"


def main() -> None:
    """Errors of the first comparison, inputs of the second."""
    for name, folder, draw in (("errors", sys.argv[1], errors), ("inputs", sys.argv[2], wanted)):
        figure = draw(Comparison.from_json((Path(folder) / "comparison.json").read_text(encoding="utf-8")))
        if figure is not None:
            with mpl.rc_context(STYLE):
                figure.savefig(IMAGES / f"laws-{name}.png", dpi=110)


if __name__ == "__main__":
    main()
