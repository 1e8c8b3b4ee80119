"""Flights with agents and plant in one process, without network, camera and boards.

fleet.py steps them together as fast as it goes; resume.py goes on from a moment of a recorded run.
"""
