"""Images of pixels: masks, clusters, and the noise of a cloud."""
