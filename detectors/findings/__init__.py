"""Findings off the surface: clusters, thresholds, sizes, missing returns."""
