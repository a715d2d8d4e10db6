"""Factors by SuperLU where PARDISO is installed too."""

from __future__ import annotations

from functools import partial
from unittest import mock

from modetune.core.algebra import factorisation

#: A context in which SuperLU factorises.
superlu_only = partial(mock.patch.object, factorisation, "is_available", lambda: False)
