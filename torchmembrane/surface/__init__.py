"""The surface: shapes, the triangulated grid and who neighbours whom in it, its stencil, tangents, projection onto it."""
