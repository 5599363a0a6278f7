"""The claims of the thesis that the reference experiments repeat: their rules, their verdicts, their tables.

Only reports on the thesis' own target ask this room.
"""
