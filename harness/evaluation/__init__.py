"""From result tables to statistics: rates with intervals, noise against frames, verdicts on claims."""
