"""The mission: from robots lying in the water to a run that is over. Pure.

One table holds states and events (state_machine.py). mission.py takes one step a cycle: what the fleet says and what people
ask go in, commands for robots come out. Time is an argument everywhere.
"""
