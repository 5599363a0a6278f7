"""The user's own camera: measurement from static captures, a camera file that reproduces it, page and certificate."""
