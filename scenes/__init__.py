"""Everything up to a frame: target, light transport, camera models. Knows nothing of detectors."""
