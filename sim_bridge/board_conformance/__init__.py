"""A test bench for real thruster boards: does a firmware keep the rules of docs/board.md?

rules.py and thrust.py hold the rules, probe.py speaks to the board, runner.py tries each rule and measures, cli.py prints.
"""
