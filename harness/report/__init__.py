"""Figures and pages from result tables."""
