"""Checks that a method meets the requirements of the trainer and the evaluator.

In a test of your package:

    from nerfloom.testing import assert_method

    def test_the_method():
        assert_method(METHOD)
"""

from __future__ import annotations

from nerfloom.testing.check import assert_method as assert_method
from nerfloom.testing.check import check_method as check_method
from nerfloom.testing.finding import Finding as Finding
