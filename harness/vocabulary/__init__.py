"""Types and functions that every room uses: captures, lenses, geometry, units, errors, seeds,
files."""
