"""Frames become one cloud: averages, noise, flat fields."""
