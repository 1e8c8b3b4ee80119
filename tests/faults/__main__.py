"""SHELL: `make faults`: breaks everything in the table, many times, and says how it went. Writes docs/evidence/faults.md.

python -m tests.faults                              every row, as often as it says
python -m tests.faults --row agent-killed --times 5
"""

import argparse
import json
import sys
import time
from contextlib import ExitStack

import numpy as np
from rich.console import Console
from rich.table import Table

from tests.faults.onlooker import Stuck
from tests.faults.page import PAGE, RESULTS, RowOutcome, machine, verdict, write_page
from tests.faults.rig import Rig, moment
from tests.faults.rigs import RIGS
from tests.faults.row import FaultRow, Sample
from tests.faults.table import ROWS

MAX_STUCK = 3  # of a row, before it is given up


def fly_row(row: FaultRow, times: int, seed: int, console: Console) -> RowOutcome:
    """All injections of a row. A rig that gets stuck, or a row that breaks, fails this row alone; the rig is built anew."""
    samples: list[Sample] = []
    stuck: list[str] = []
    wrong = not_finite = 0
    while len(samples) + len(stuck) < times and len(stuck) < MAX_STUCK:
        with ExitStack() as stack:
            rig: Rig | None = None
            try:
                rig = stack.enter_context(RIGS[row.rig](seed)) if row.rig else None
                while len(samples) < times:
                    random = np.random.default_rng([seed, len(samples)])
                    if rig is not None:
                        rig.cruise(moment(random))
                    samples.append(row.inject(rig, random))
                    shown = "  ".join(f"{name} {value:.3f}" for name, value in samples[-1].items())
                    console.print(f"{row.key} {len(samples)}/{times}: {shown}", highlight=False, soft_wrap=True)
            except Exception as error:
                stuck.append(str(error) if isinstance(error, Stuck) else f"{type(error).__name__}: {error}")
                console.print(f"[red]{row.key}: {stuck[-1]}[/]", soft_wrap=True)
            if rig is not None:
                wrong, not_finite = wrong + rig.wrongly_taken(), not_finite + rig.not_finite
    return RowOutcome.of(row, samples, seed, stuck, wrong, not_finite)


def keep(result: RowOutcome) -> None:
    """At once: hours of injections must not be lost to whatever ends the last of them."""
    kept = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else {}
    kept[result.key] = result.as_json()
    in_order = {row.key: kept[row.key] for row in ROWS if row.key in kept}
    RESULTS.write_text(json.dumps(in_order, indent=1) + "\n", encoding="utf-8")
    write_page(PAGE, ROWS)


def main() -> int:
    """See the module's docstring."""
    parser = argparse.ArgumentParser(prog="make faults", description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--row", action="append", choices=[row.key for row in ROWS], help="only this one; repeatable")
    parser.add_argument("--times", type=int, help="injections of each row")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--page", action="store_true", help="only write the page again")
    parser.add_argument("--dry", action="store_true", help="leave docs/ as it is")
    options = parser.parse_args()
    if options.page:
        write_page(PAGE, ROWS)
        return 0
    console, begin_s = Console(), time.monotonic()
    chosen = [row for row in ROWS if options.row is None or row.key in options.row]
    results = []
    for row in chosen:
        results.append(fly_row(row, options.times or row.times, options.seed, console))
        if not options.dry:
            keep(results[-1])
    table = Table("row", "measure", "N", "median", "worst", "limit", "", title=machine())
    for result in results:
        for name, figure in result.figures.items():
            table.add_row(result.key, name, *figure.shown, verdict(figure.kept, figure.times))
        for text in result.stuck:
            table.add_row(result.key, text, "", "", "", "", verdict(False))
    console.print(table)
    wrong, not_finite = sum(r.wrong for r in results), sum(r.not_finite for r in results)
    console.print(f"commands wrongly taken: {wrong}; numbers not finite: {not_finite}; {time.monotonic() - begin_s:.0f} s")
    return 0 if all(result.kept for result in results) else 1


if __name__ == "__main__":
    sys.exit(main())
