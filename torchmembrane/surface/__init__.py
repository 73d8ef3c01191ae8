"""The rest surface: its shapes, the triangulated grid and its topology, tangents, and projection of points and rays onto it."""
