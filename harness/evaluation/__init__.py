"""Statistics of result tables: rates with intervals, noise by frames, comparisons of set-ups."""
