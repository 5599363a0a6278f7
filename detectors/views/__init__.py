"""Several views of a target: marks, registration, one merged map."""
