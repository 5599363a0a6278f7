"""One trial: a board becomes frames, a cloud, evidence, findings and rows."""
