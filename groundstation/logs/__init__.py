"""The run's log: written while it is flown, read and repaired afterwards.

Bytes from the bus go into an MCAP file (recorder.py); a cut file is mended (repair.py); reader.py gives checked messages.
"""
