"""`tofpod implant`: simulated damage in the user's own captures."""
