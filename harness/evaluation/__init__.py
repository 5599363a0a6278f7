"""From result tables to statistics: rates with intervals, noise against frames, comparisons of set-ups."""
