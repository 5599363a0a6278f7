"""`tofpod ask`: limits of an atlas that was computed before, and between its set-ups."""
