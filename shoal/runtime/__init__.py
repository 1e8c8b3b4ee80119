"""The parts around the core of every process: time, a clean stop, a log, options, output files.

A command line (cli_options.py) starts a loop that is driven by a clock and a stop (runtime.py). The core inside is pure.
"""
