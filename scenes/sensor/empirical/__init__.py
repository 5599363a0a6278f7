"""The empirical camera: statistics of a unit's captures, without a model of the measurement."""
