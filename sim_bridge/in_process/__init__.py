"""Flights in one process.

fleet.py steps agents and plant, without network, camera and boards; run.py plans, records and reports; resume.py continues
from a moment of a recorded run. executor.py steps the nodes of all programs, as they run in lockstep.
"""
