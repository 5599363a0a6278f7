"""Audit: how often everything that is quoted covers the truth."""
