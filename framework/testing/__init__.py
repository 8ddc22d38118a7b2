"""Checks for a method's author: does it keep what the trainer and the evaluator rely on?

In a test of your package:

    from framework.testing import assert_method

    def test_the_method():
        assert_method(METHOD)
"""

from __future__ import annotations

from framework.testing.check import assert_method as assert_method
from framework.testing.check import check_method as check_method
from framework.testing.finding import Finding as Finding
