"""The sensor: its description, its file, and the mechanics of its membrane."""
