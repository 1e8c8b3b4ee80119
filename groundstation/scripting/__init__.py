"""Scripts of a station, as `import shoal` offers them.

A connected fleet (fleet.py), and flown runs as tables (runs.py).
"""
