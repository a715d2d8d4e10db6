"""Modes before and after, as files for ParaView."""
