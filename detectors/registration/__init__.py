"""Rigid registration of views of one target: where each stands to the first, how well that is known, and when not."""
