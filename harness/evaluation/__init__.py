"""Statistics of result tables: rates with intervals, noise against frames, comparisons of set-ups."""
