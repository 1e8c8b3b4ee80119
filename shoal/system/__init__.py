"""The machine that a program runs on: other programs, files of any kind, secrets, loopback addresses, terminals' characters.

Small parts that know nothing of robots; every other part of `shoal` may use them.
"""
