"""The mission: from robots at rest in the water to the end of the run. Pure.

One table holds states and events (state_machine.py). mission.py takes one step a cycle: robot states and operator requests go
in, commands for robots come out. Time is an argument everywhere.
"""
