"""Elastic energies of the membrane, and the cavity it encloses."""
