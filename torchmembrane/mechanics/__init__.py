"""Elastic energies of the membrane, and the cavity that it encloses."""
