"""Scales of the search for dots: how far they move (in pitches), how well neighbours predict them, and what is too faint."""

import math

STEPS = 3
"""Number of iterations of the refinements in the search, and of the fit."""
REACH = 2.5
"""Largest distance of a dot from its expected position, and of two neighbours, pitches."""
PREDICTION = 0.3
"""Standard deviation of a position predicted by neighbours, in pitches, and of a step between them, relative to its length."""
NEIGHBOURS = 8
"""Number of neighbours whose arrangement, sizes and contrasts are compared: those around a dot in a square pattern."""
CANDIDATES = int(math.pi * REACH**2)
"""Number of blobs among which a dot chooses, and for whose shifts it votes: the number within `REACH`."""
FAINT = 0.35
"""Strength of a blob, relative to the clearer blobs of the frame, at which it is as likely a dot as not; also the contrast,
relative to the dots, of a pixel that stands out."""
SHADE = 0.05
"""Contrast of dirt and shadows in any frame."""
LOST = 0.02
"""Prior probability that a dot is lost."""
RIDGE = 0.5
"""Ridge that pulls a gradient towards the previous one where the neighbours do not determine it."""
NONE = 0.1
"""Weight of having no blob in soft assignments, relative to that of a blob at the expected position."""
FAR = 1e6
"""Cost of impossible choices."""
