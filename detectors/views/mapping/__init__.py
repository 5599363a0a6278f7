"""Merging registered views into one cloud: the thesis' grid, a fused map with its variance, a
volume."""
