"""Tests of deployments and workers."""
