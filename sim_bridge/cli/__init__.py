"""The commands of `sim-bridge`: whole flights, the simulated pool, comparisons of controllers.

A command reads its options, calls one function of the package below it, prints the outcome and gives the exit code.
"""
