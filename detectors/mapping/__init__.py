"""Merging registered views into one cloud: the thesis' grid, a fused map with its variance, a volume."""

from __future__ import annotations
