"""The scorecard: measurements of simulated cameras beside published measurements of the real ones."""
