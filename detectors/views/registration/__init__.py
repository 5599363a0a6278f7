"""Rigid registration of views of one target: the pose of each relative to the first, its
uncertainty, and failures."""
