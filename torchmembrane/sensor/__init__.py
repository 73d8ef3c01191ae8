"""A sensor: what is known of it, its file, and the mechanics that follow from it."""
