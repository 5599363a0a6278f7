"""The undamaged surface of a cloud: fitted shapes, their choice, references."""
