"""The scanned lidar: its numbers, the correlation of its coded pulse, its processing."""
