"""`tofpod start`: from plain questions to an experiment and three commands."""
