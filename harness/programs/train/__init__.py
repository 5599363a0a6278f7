"""`tofpod train`: the network of the detector `learned`, trained on simulated boards."""
