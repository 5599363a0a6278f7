"""Camera models: noise-free phasors to noisy frames. Code by kind of camera, numbers in scenes/cameras/*.yaml."""
