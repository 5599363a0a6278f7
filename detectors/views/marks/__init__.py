"""Fiducial marks: found by colour or by code, with their place in space and how well it is
known."""
