"""Content keys: the identity of a job is everything that can change its numbers.

The key is the SHA-256 of a canonical JSON text (sorted keys, no spaces, plain ASCII). Paths, job
names, time, host and modetune's own version are kept out of it on purpose, so that a result found
once is found again by anyone who asks the same question.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence

Json = str | int | float | bool | None | Sequence["Json"] | Mapping[str, "Json"]


def canonical_json(content: Json) -> str:
    """One text for one content: sorted keys, no spaces, ASCII; NaN and infinity are refused."""
    return json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)


def content_key(canonical: str) -> str:
    """SHA-256 of a canonical JSON text, 64 hexadecimal digits."""
    return hashlib.sha256(canonical.encode("ascii")).hexdigest()


def number_or_null(value: float) -> float | None:
    """A plain number for JSON; what is not finite is null."""
    return float(value) if math.isfinite(value) else None
