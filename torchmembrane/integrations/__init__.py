"""Formats and viewers of other programs, each installed as an extra."""
