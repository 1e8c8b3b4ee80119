"""Software in the loop: every process of an experiment on this machine, watched, ended and reported.

commands.py says what is started, processes.py holds it, monitor.py shows it, fault_injector.py breaks it on time, launcher.py
leads.
"""
