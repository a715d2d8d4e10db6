"""modetune: finite element models that agree with vibration tests."""

__version__ = "0.1.0"
