"""The experiment file and every section of it, checked key by key.

A TOML file and `--set` changes go in (experiment.py), one frozen `Experiment` comes out, the same in every process: its hash
travels with the commands. Vehicles and shipped experiments lie beside this folder. One module holds one section.
"""

LARGEST_ROBOT = 49  # the marker of a robot is, unless told otherwise, that of its number, of 50
