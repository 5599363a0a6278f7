"""The target: its declaration, its meshes, its truth and its export. Knows nothing of light or cameras."""
