"""Values that do not belong where they are put: numbers at the ends of their types, names that lead elsewhere."""

import math

WHOLE = (0, 1, 2**15, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**63, 2**64 - 1)
REAL = (0.0, -1.0, math.nan, math.inf, -math.inf, 5e-324, 1e-60, 1e-45, 1e38, 3.5e38, 1e200, 1.7e308)
NUMBERS = (
    "nan", "NaN", "inf", "-inf", "Infinity", "1e999", "1e300", "3.5e38", "1e-320", "-1", "0", "-0.0", "2147483648",
    "18446744073709551616", 400 * "9", "0x" + 40 * "f", "1_0", "\u0663", "1e", "--1", "1.2.3", "", "x", "true", "null",
)  # fmt: skip
"""As they stand in text."""
NAMES = (
    "", "x", ".", "..", "/", "../../x", "../outside/secret", "/etc/hostname", "/dev/null", "images", "images/", "a\nb",
    "a\0b", "\x1b[2J", "\ud800", 300 * "a", 3000 * "a/", 200 * "\u00e9", "a\\b", "C:\\x", "~", "%s", "{0}",
    "con", "-rf",
)  # fmt: skip
"""Names of files."""
LETTERS = ("\0", "\ufeff", "\r", "\u2028", "\x1b[31m", "\ud800", "\u0663", "\U0001f600", "\t", "\n\n", "'", '"', "\\")
"""Characters that come as a surprise in text."""
DEEP = "@deep@"
"""Stands for something nested deeper than one would nest anything."""
DEPTHS = (60, 500, 900, 950, 985, 100_000)
"""Python gives up at about a thousand."""
PLAIN = (
    None, True, False, *WHOLE, -(2**63), 10**400, *REAL, *NAMES, "nan", "1", [], {}, [[]], [1], ["x"], {"a": 1}, DEEP,
)  # fmt: skip
"""All kinds of values in JSON."""
