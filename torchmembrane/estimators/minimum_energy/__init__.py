"""Minimum energy: the surface of least elastic energy on the observed rays."""
