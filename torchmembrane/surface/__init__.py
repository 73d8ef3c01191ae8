"""The rest surface: shapes, the triangulated grid and its neighbourhoods, tangents, and projection onto the surface."""
