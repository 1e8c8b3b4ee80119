"""A test bench for real thruster boards against the rules of docs/board.md.

rules.py holds the rules and their checks, probe.py speaks to the board, runner.py tries each rule and measures, cli.py
prints.
"""
