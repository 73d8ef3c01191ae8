"""Estimators, which reconstruct the surface from the rays of the markers."""
