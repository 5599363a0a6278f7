"""What lies off the surface: clusters, thresholds, sizes, missing returns."""
