"""`tofpod efficiency`: detectors of a study compared with an ideal observer."""
