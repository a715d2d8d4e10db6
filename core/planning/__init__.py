"""Sensor and exciter places, and points in the space of parameters."""
