"""Flights with agents and plant in one process, without network, camera and boards.

fleet.py steps them together as fast as possible; run.py plans, records and reports; resume.py continues from a moment of a
recorded run.
"""
