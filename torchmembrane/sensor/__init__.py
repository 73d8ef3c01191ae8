"""A sensor: what is known of it, and its file."""
