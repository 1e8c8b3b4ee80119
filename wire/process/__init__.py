"""What every process has around its core: time, a clean stop, a log, options, files that it writes.

A command line (cli_options.py) starts a loop that is driven by a clock and a stop (runtime.py), or in
lockstep by the simulator (lockstep.py). The core inside is pure.
"""
