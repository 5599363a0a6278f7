"""The detectors, found by name through `detectors.BUILT_IN`."""
