"""Lockstep: the simulator owns time, and a step begins when all of its inputs are here.

clock.py is the simulator's clock in another process, and its waiting. agent.py, localizer.py and station.py give this clock,
and a pace by it, to the nodes of the other programs, which know nothing of it. `python -m sim_bridge.lockstep` starts such
nodes as processes.
"""
