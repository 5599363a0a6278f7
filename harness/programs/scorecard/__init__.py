"""The scorecard: measurements of simulated cameras compared with published measurements of real
cameras."""
