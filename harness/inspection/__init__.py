"""The work of `harness.detect`: from captures and arguments to findings, told and written."""

from __future__ import annotations
