"""Static captures, real or simulated: statistics of their frames."""
