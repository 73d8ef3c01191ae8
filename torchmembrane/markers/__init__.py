"""Markers on the membrane: placed on the rest surface, located in images, screened for wrong matches."""
