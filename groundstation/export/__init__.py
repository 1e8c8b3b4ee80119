"""A recorded or running fleet for other programs: tables, and Foxglove live or as a file.

Log messages become CSV or Parquet (tables.py), or the channels, scene and layout that Foxglove draws (foxglove_*.py).
"""
