"""Mutants: small faults of the numeric modules, which the tests of a room must notice."""
