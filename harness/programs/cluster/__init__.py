"""Sweeps on many machines: the Dask engine, and `tofpod merge`, which joins shards."""
