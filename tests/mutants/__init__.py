"""Mutants: small faults put into the numeric modules, which the tests of a module's room must notice."""
