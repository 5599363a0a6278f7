"""Probability of detection by the field's standard (MIL-HDBK-1823A): pure statistics of any
inspection data."""
