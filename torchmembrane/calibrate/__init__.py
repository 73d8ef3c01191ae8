"""Calibration (section 5.2): lens, ports, rest surface and dots from images, and the way back, from image to fabrication layout."""
