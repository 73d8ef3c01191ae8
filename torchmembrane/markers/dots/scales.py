"""What the search for dots measures by: how far they move in pitches, how well neighbours predict them, what is too faint."""

import math

STEPS = 3
"""Of the search's refinements, and of the fit."""
REACH = 2.5
"""Of a dot from where it is expected, and of an edge between neighbours."""
PREDICTION = 0.3
"""Standard deviation of where neighbours predict a dot, and of a step between them over its length."""
NEIGHBOURS = 8
"""Of a dot, whose arrangement, sizes and contrasts are compared: all that surround it in a square pattern."""
CANDIDATES = int(math.pi * REACH**2)
"""Blobs among which a dot chooses, and for whose shifts it votes: as many as lie within `REACH`."""
FAINT = 0.35
"""Strength of a blob, over that of the frame's clearer ones, that is as likely a dot as none; over the dots' contrast, that of
what stands out."""
SHADE = 0.05
"""Contrast of dirt and shade in any frame."""
LOST = 0.02
"""Share of dots lost where none is known to be."""
RIDGE = 0.5
"""Draws a gradient to the one before, where neighbours do not fix it."""
NONE = 0.1
"""Weight of no blob, where dots are laid on blobs softly, beside that of a blob right there."""
FAR = 1e6
"""Cost of what is out of the question."""
