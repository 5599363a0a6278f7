"""The leaf: words that every room shares: captures, lenses, geometry, units, errors, seeds, files."""
