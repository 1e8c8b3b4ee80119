"""`python -m benchmarks robots`: a grid of numeric flights that no constant was tuned on, for every law and observer.

Cells, flights and their figures are those of tests/flights, which tests fly too.

report.py     tables of cells, worst flights, targets; the same beside an earlier run
program.py    command line, worker processes, evidence
"""
