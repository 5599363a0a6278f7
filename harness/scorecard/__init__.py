"""The scorecard: what a simulated camera does, measured as one measures a real one, beside what was published of it."""
