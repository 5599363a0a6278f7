"""`tofpod dataset`, `score` and `export`: simulated boards as files, and the limits of anomaly
maps on them."""
