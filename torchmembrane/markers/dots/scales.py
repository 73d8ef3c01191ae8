"""What the search for dots measures by, in pitches: how far they move, and how well their neighbours predict them."""

REACH = 2.5
"""Of a dot from where it is expected, and of an edge between neighbours."""
PREDICTION = 0.3
"""Standard deviation of where neighbours predict a dot, and of a step between them over its length."""
CANDIDATES = 24
"""Blobs among which a dot chooses, and for whose shifts it votes."""
NONE = 0.1
"""Weight of no blob, where dots are laid on blobs softly, beside that of a blob right there."""
FAR = 1e6
"""Cost of what is out of the question."""
