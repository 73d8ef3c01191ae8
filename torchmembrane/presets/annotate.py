"""Comments in a drafted sensor file, with which `torchmembrane init` explains every key."""

import re
from collections.abc import Sequence
from pathlib import Path

from ..files.atomic import write_text
from ..sensor.units import METRE, millimetre

WORDS = {
    "": {
        "format": "of this file",
        "name": "any text",
        "length_unit": f"{' | '.join(METRE)}: of all lengths here and in results",
    },
    "camera": {
        "name": "of the view, and of its images, NAME_VIEW.png",
        "pose": "of this camera's frame in the first one's; `calibrate rest` finds it from a rest image of each",
        "model": "pinhole (OpenCV's k1 k2 p1 p2 k3, or with k4 k5 k6) | fisheye (k1 to k4; ROS: equidistant)",
        "image_size": "width, height, px",
        "focal": "focal lengths along u and v, px; for a fisheye px / rad",
        "centre": "principal point u, v, px; the top left pixel's centre is 0, 0",
        "bits": "bits that the camera uses of 16-bit images",
        "distortion": "OpenCV's coefficients; `calibrate camera` finds all of these from a checkerboard",
    },
    "membrane": {
        "shape": "spherical_cap | ellipsoid_cap | half_cylinder | grid | heightfield | inflated",
        "grid": "vertices of the solver; leave the line out for the default",
        "rim_radius": "radius of the fixed circle",
        "height": "height of the pole, or of the highest point of an inflated sheet, over the rim's plane",
        "outline": "rectangle | ellipse, with size; or a file of the rim's points once around, x,y or x,y,z",
        "size": "size of the rim along x and y",
        "corner": "radius of the rectangle's corners",
        "overpressure": "pressure inside minus outside at rest, hPa, instead of the height",
        "base_z": "distance of the rim's plane from the camera's centre of projection; negative if it lies behind a fisheye",
        "semi_axes": "semi-axes along x, y, z",
        "radius": "radius of the cylinder",
        "length": "length along x, the image's u",
        "half_angle": "angle from the top to either side, degrees",
    },
    "material": {
        "model": "neo_hookean | mooney_rivlin (with c2_ratio) | harmonic",
        "prestretch": "stretch at rest, relative to the unstretched membrane, 1 or more",
        "shear_modulus": "N / length unit^2",
        "thickness": "thickness at rest: unstretched thickness / prestretch^2",
        "friction": "coefficient of friction of the bodies that are expected; 0.5 if left out",
    },
    "cavity": {
        "filling": "liquid (keeps its volume) | gas (keeps pressure x volume) | open (keeps its pressure)",
        "pressure": "absolute pressure of a gas at rest, hPa: the atmosphere's, about 1013, plus the overpressure",
        "volume": "volume of a gas including tubes, length unit^3; leave the line out for the volume under the membrane",
    },
    "markers": {
        "kind": "dots | texture",
        "polarity": "dark | light: the markers relative to the membrane around them",
        "file": "table x,y,z,size of all dots at rest, in the camera's frame, length unit",
        "height": "height of the dots over the inner side (tips of pins), length unit",
        "rest_image": "image without contact; or a list of images, or a pattern with *, which are averaged",
    },
}
"""Comments by table and key."""
RELATIVE = """\
# shear_modulus = {modulus:<6g} # N / length unit^2; without it and thickness forces are relative. From one known weight:
# thickness = {thickness:<10g} # torchmembrane calibrate material sensor.toml press.png --weight 200g --out material"""
FURTHER = """\
# [[camera.ports]]     # flat windows, in order from the camera; what is behind the last one is the medium
# distance = {distance:<11g} # from the centre of projection to the near face
# thickness = {window:g}
# index = 1.49
# [camera.medium]
# index = 1.33

# [tool]               # the camera's pose on a robot: p_tool = rotation p_camera + translation
# rotation = [0, 0, 0] # rotation vector, degrees; or three rows of three
# translation = [0.0, 0.0, 0.0]"""
OF_EXAMPLES = {"thickness": 0.5, "distance": 2.0, "window": 3.0}  # mm, values of keys that are commented out
MODULUS = 0.3  # N / mm^2
OF_SHEETS = {
    "prestretch": "stretch of the flat sheet in its rim before it is inflated, 1 or more",
    "thickness": "thickness of the flat sheet in its rim before it is inflated: unstretched thickness / prestretch^2",
}
"""Comments of `[material]` if the shape is "inflated"."""


def annotate(path: Path, said: Sequence[str], relative: bool, unit: str) -> None:
    """Add comments to the keys of a sensor file, and further possible keys at its end, commented out.

    Args:
        path: path of a file that `Sensor.to_file` has written.
        said: sentences for its top, on assumed or derived values.
        relative: whether forces are relative, so that the keys that give newtons are added as comments.
        unit: length unit of the file, in which the values of further keys are given.
    """
    one = millimetre(unit)
    examples = {name: length * one for name, length in OF_EXAMPLES.items()} | {"modulus": MODULUS / one**2}
    table, lines, content = "", [f"# {sentence}" for sentence in said], path.read_text(encoding="utf-8")
    words = WORDS | {"material": WORDS["material"] | OF_SHEETS} if 'shape = "inflated"' in content else WORDS
    for line in content.splitlines():
        if head := re.fullmatch(r"\[+([\w.]+)\]+", line):
            table = head[1]
        key = line.partition(" = ")[0]
        word = words.get(table, {}).get(key)
        lines.append(f"{line}  # {word}" if word else line)
        if table == "material" and key == "prestretch" and relative:
            lines.append(RELATIVE.format(**examples))
    write_text(path, "\n".join([*lines, "", FURTHER.format(**examples)]) + "\n")
