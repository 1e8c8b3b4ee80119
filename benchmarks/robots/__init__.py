"""`python -m benchmarks robots`: a grid of numeric flights that no constant was tuned on, for every law and observer.

cells.py      names the cells; `draw` makes the n-th flight of a cell, always the same, as settings of an experiment
flights.py    flies it (water.py: fleet and plant that can be held fast, blinded, swept away)
figures.py    figures of the flight, from the plant's truth (claims.py: the observer's own idea of its errors)
report.py     tables of cells, worst flights, targets; the same beside an earlier run
program.py    command line, worker processes, evidence
"""
