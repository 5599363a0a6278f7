"""``tofpod filters``: what a filter from depth to depth costs."""
