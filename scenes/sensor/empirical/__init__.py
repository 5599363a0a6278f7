"""The empirical camera: statistics of a real unit's captures, without a model of the measurement."""
