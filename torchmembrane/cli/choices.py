"""Choices and defaults of the command's options, repeated here so that `--help` loads nothing heavy.

A test compares all of them with the package.
"""

ESTIMATORS = ("force-balance", "minimum-energy", "paper")
LOCATORS = ("fit", "soft")
ENERGIES = ("harmonic", "neo_hookean", "mooney_rivlin")
FLOWS = ("smooth", "bilinear")
ENGINES = ("local", "ray")
RESULT_FORMATS = ("npz", "parquet")
FIELDS = ("stretch", "tension")

DRAFTS = ("dome", "cap", "bubble", "fingertip", "half_cylinder", "rectangle", "ellipse")
OUTLINE = "outline"  # the shape of --outline
LENGTH_UNITS = ("mm", "cm", "m", "um", "inch")
LENSES = ("pinhole", "fisheye")
LONGEST_SIDE = 16384
FARTHEST = 1e6
FILLINGS = ("liquid", "gas", "open")
POLARITIES = ("dark", "light")
FROM_IMAGE = "auto"  # of --rim: the circle is found in the rest image

PRESETS = ("fingertip", "bubble", "half_cylinder")
INDENTERS = ("sphere", "cylinder", "wedge", "box", "plane")
LEGS = ("push", "slide", "release")
SIMULATION_FORMATS = ("png", "parquet")
HIGHLIGHT, BLUR = 0.0, 0.6
MOST_BLUR, MOST_DECIBEL = 20.0, 200.0
MOST_FRICTION, MOST_LINES = 10.0, 129

PORTS = ("port_distance", "port_thickness", "port_index", "medium_index")
HEIGHT_ERROR, MOST_HEIGHT_ERROR = 0.05, 0.5
