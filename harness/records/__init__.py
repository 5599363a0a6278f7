"""Rows of trials as typed records, the tables that hold them, and the files that programs write."""
