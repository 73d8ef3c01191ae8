"""Minimum energy: the surface with the least elastic energy on the observed rays."""
