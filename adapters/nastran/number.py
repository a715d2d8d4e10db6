"""Numbers as Nastran writes them: `7.1+4`, `7.1D4`, `-.5`, and as many digits as a field holds."""

from __future__ import annotations

import math
import re

#: Digits with or without a point, then an exponent with or without its letter.
NUMBER = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+))(?:[ED]([+-]?\d+)|([+-]\d+))?", re.IGNORECASE)
#: Beyond this many digits a double has nothing more to tell.
DIGITS = 17


def read_number(text: str) -> float:
    """A number as Nastran reads it: 7.1E4, 7.1d4 and 7.1+4 are one. Raises ValueError."""
    found = NUMBER.fullmatch(text.strip())
    if found is None:
        raise ValueError(f"{text!r} is not a number")
    mantissa, lettered, bare = found.groups()
    value = float(f"{mantissa}e{lettered or bare or 0}")
    if not math.isfinite(value):
        raise ValueError(f"{text!r} is not finite")
    return value


def format_number(value: float, width: int) -> str:
    """The text of at most `width` characters that is nearest to a real number.

    It always has a decimal point, for Nastran takes a number without one for an integer. Eight
    characters hold four to seven digits (four in -1.234-10, seven in 1234567.): the same number
    always gives the same text, so what a job runs is what an updated deck says.
    Raises ValueError where the value is not finite or no text fits.
    """
    if not math.isfinite(value):
        raise ValueError(f"{value} is not a finite number")
    if value == 0.0:
        return "0."
    texts = [*_plain(value, width), *_with_exponent(value, width)]
    if not texts:
        raise ValueError(f"{value!r} does not fit {width} characters")
    # Of two that are equally near the first is taken, the one without an exponent.
    return min(texts, key=lambda text: abs(read_number(text) - value))


def _plain(value: float, width: int) -> list[str]:
    """The longest text without an exponent that fits, if any keeps a digit."""
    if not 1e-8 < abs(value) < 10.0**width:
        return []
    for decimals in range(DIGITS, -1, -1):
        whole, _, part = f"{value:.{decimals}f}".partition(".")
        whole = whole.replace("-0", "-") if whole.startswith("-0") else whole
        text = f"{'' if whole == '0' else whole}.{part.rstrip('0')}"
        if len(text) <= width and any(digit in text for digit in "123456789"):
            return [text]
    return []


def _with_exponent(value: float, width: int) -> list[str]:
    """The longest text with an exponent that fits, as 7.1+4."""
    for digits in range(DIGITS, 0, -1):
        mantissa, _, exponent = f"{value:.{digits - 1}e}".partition("e")
        mantissa = mantissa.rstrip("0") if "." in mantissa else f"{mantissa}."
        text = f"{mantissa}{int(exponent):+d}"
        if len(text) <= width:
            return [text] if _finite(text) else []
    return []


def _finite(text: str) -> bool:
    """Whether rounding has not carried the largest doubles past what a double holds."""
    try:
        read_number(text)
    except ValueError:
        return False
    return True
