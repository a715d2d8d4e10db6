"""A frame for OpenSeesPy, which modetune has no adapter for."""
