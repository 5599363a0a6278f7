"""Recordings that a stranger could bring, made by ray casting with known truth, and the score of
`tofpod detect`."""
