"""The commands of `groundstation`, one module for each group.

A command reads its options, calls one function of the package below it, prints the outcome and gives the exit code.
"""
