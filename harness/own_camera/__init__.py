"""The user's own camera: what its static captures tell, the camera file that repeats it, its page and certificate."""
