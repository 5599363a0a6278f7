"""The empirical camera: what captures of a real unit show, without a model of how it measures."""
