"""``tofpod record``: frames of a camera or of a file, watched while they come, as a capture."""
