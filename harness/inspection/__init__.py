"""What `harness.detect` does, step by step: one capture, or several views as one cloud."""

from __future__ import annotations
