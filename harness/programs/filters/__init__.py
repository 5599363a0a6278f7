"""``tofpod filters``: states what a filter from depth to depth costs."""
