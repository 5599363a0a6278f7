"""The continuous-wave (AMCW) imager: its numbers, its exposure, its depth engine."""
