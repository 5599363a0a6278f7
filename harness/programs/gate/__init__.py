"""`tofpod compare` and `check`: two studies compared, a gate for CI, and its pytest fixture."""
