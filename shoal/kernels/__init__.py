"""Numeric kernels: loops and equations over numbers, arrays and records, compiled once for a machine.

`@kernel` (decorator.py) compiles a function for the types of its annotations (types.py). Its machine code is kept on disk
(cache.py) under a stamp of its content (stamp.py); what is missing there is compiled for a whole package in processes of their
own (build.py, worker.py). Imports nothing: a program that has its kernels compiled need not load Numba.
"""
