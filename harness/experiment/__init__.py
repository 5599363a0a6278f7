"""The YAML of an experiment: read with places, validated all at once, unfolded into points. Runs nothing."""
