"""The simulation up to a frame: target, light transport, camera models. It does not import
detectors."""
