"""The GARTEUR SM-AG19 aircraft testbed."""
