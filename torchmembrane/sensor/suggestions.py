"""Suggestions for misspelt or synonymous words in sensor files and commands."""

import difflib
from collections.abc import Iterable

ALIASES = {
    "spherical_cap": ("half_sphere", "hemisphere", "sphere", "dome", "bubble", "cap", "spherical"),
    "ellipsoid_cap": ("half_ellipsoid", "ellipsoid", "fingertip", "finger"),
    "half_cylinder": ("cylinder", "cylindrical", "semi_cylinder", "tube"),
    "heightfield": ("height_field", "heightmap", "height_map", "heights", "plane", "flat", "pad"),
    "inflated": ("blown_up", "balloon", "sheet", "window", "membrane", "rectangle", "ellipse", "outline"),
    "grid": ("mesh", "stl", "points", "vertices"),
    "neo_hookean": ("neohookean", "neo_hooke", "rubber", "silicone", "hyperelastic"),
    "mooney_rivlin": ("mooney", "rivlin"),
    "harmonic": ("linear", "soap_film"),
    "liquid": ("water", "oil", "gel", "fluid", "silicone_oil", "closed"),
    "gas": ("air", "pneumatic", "nitrogen"),
    "open": ("vented", "none", "empty", "pressure"),
    "dots": ("dot", "markers", "points", "pins", "blobs"),
    "texture": ("speckle", "paint", "pattern", "random"),
    "dark": ("black", "dark_on_light"),
    "light": ("white", "bright", "light_on_dark"),
    "pinhole": ("perspective", "opencv", "rectilinear", "plumb_bob", "rational_polynomial", "radtan"),
    "fisheye": ("kannala_brandt", "equidistant", "omnidirectional", "wide"),
    "rim_radius": ("radius", "rim", "base_radius", "diameter"),
    "base_z": ("distance", "z", "rim_z", "offset"),
    "half_angle": ("angle", "opening", "opening_angle"),
    "semi_axes": ("axes", "radii", "half_axes"),
    "pressure": ("overpressure", "gauge_pressure", "absolute_pressure"),
    "shear_modulus": ("modulus", "mu", "youngs_modulus", "stiffness"),
    "prestretch": ("stretch", "pretension", "prestrain"),
    "image_size": ("resolution", "size", "width", "height"),
    "mm": ("millimetre", "millimetres", "millimeter", "millimeters"),
    "cm": ("centimetre", "centimetres", "centimeter", "centimeters"),
    "m": ("metre", "metres", "meter", "meters"),
    "um": ("\u00b5m", "\u03bcm", "micron", "microns", "micrometre", "micrometres", "micrometer", "micrometers"),
    "inch": ("in", "inches"),
    "focal": ("focal_length", "fx", "fy", "f"),
    "centre": ("center", "principal_point", "cx", "cy"),
    # options of the command
    "dome": ("half_sphere", "hemisphere", "sphere", "spherical"),
    "cap": ("spherical_cap", "spherical_segment"),
    "bubble": ("balloon", "pillow"),
    "fingertip": ("ellipsoid_cap", "half_ellipsoid", "ellipsoid", "finger"),
    "radius": ("rim_radius", "diameter"),
    "view": ("fov", "hfov", "field_of_view", "angle_of_view"),
    "distance": ("base_z", "z", "rim_z", "working_distance"),
    "overpressure": ("pressure", "gauge_pressure", "gauge"),
    "rest": ("rest_image", "reference", "image"),
    "unit": ("units", "length_unit"),
    "weight": ("mass", "load"),
    "out": ("output", "outdir", "output_dir"),
    "camera": ("lens", "intrinsics"),
    "material": ("weight", "newtons", "stiffness", "modulus", "gauge", "force"),
}
"""Synonyms that users may write, by the word that is meant."""
HINTS = {
    "spherical_cap": "half a sphere has rim_radius = height",
    "pressure": "of a gas, absolute: the atmosphere's, about 1013 hPa, and the overpressure",
    "shear_modulus": "a third of Young's modulus",
}


def did_you_mean(word: object, choices: Iterable[str], otherwise: str = "") -> str:
    """Return a question that suggests the closest of the choices for a wrong word; `otherwise` if none is close.

    Example:
        >>> did_you_mean("half_sphere", ["grid", "spherical_cap"]), did_you_mean("neo-Hookean", ["neo_hookean"])
        ("did you mean 'spherical_cap' (half a sphere has rim_radius = height)?", "did you mean 'neo_hookean'?")
    """
    plain, choices = str(word).strip().lower().replace("-", "_").replace(" ", "_"), list(choices)
    known = [choice for choice in choices if plain == choice or plain in ALIASES.get(choice, ())]
    found = known or difflib.get_close_matches(plain, choices, 1)
    if not found:
        return otherwise
    hint = "half the diameter" if plain == "diameter" else HINTS.get(found[0], "")
    return f"did you mean {found[0]!r}{f' ({hint})' if hint else ''}?"
