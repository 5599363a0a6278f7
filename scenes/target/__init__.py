"""The target: its declaration, its meshes, its truth and its export. It does not depend on light
or cameras."""
