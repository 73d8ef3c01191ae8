"""The rest surface: shapes, the triangulated grid, its stencil."""
