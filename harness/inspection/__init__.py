"""The work of `harness.detect`: from captures and arguments to findings, printed and written."""

from __future__ import annotations
