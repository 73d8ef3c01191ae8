"""From marker rays to the surface."""
