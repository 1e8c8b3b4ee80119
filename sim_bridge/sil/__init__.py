"""Software in the loop: every process of an experiment on this machine, watched, ended and reported.

launcher.py leads: commands.py names the programs, processes.py starts and ends them, monitor.py shows the fleet,
fault_injector.py applies faults of processes on time. after_run.py shows an ended run to a page that is open.
"""
