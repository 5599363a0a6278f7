"""The contract that every detector keeps, for the tests of a plug-in's author.

from harness.testing import check_detector
"""

from harness.testing.contract import CHECKS, check_detector, learns_plain_arrays, turned_once

__all__ = ["CHECKS", "check_detector", "learns_plain_arrays", "turned_once"]
