"""Sensor and exciter places."""
