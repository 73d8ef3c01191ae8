"""A sensor as a robot part for simulators: URDF and MJCF with meshes of the rest membrane and of its rim."""

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from ..files.atomic import make_folder, write_bytes, write_text
from ..pose import Pose
from ..sensor.sensor import Sensor
from ..sensor.units import METRE
from ..surface.topology import rim_loop

RIM_WIDTH = 0.02
"""Radius of the tube drawn along the rim, relative to the extent of the membrane."""
SIDES = 8
"""Number of sides of that tube."""
OPTICAL_TO_GRAPHICS = np.diag([1.0, -1.0, -1.0])
"""Rotation to MuJoCo's camera axes (view along -z, y up) from the sensor's (view along z, y down)."""


def write_robot_model(sensor: Sensor, folder: str | Path) -> Path:
    """Write `NAME.urdf`, `NAME.xml` (MJCF), `membrane.stl` and `rim.stl`, in metres.

    The root is the frame of the tool if the sensor file has `[tool]`, otherwise the camera's frame (x right, y down, z out of
    the lens). `NAME_camera` is the camera's frame. The membrane's mesh is closed by a lid across the rim, because simulators
    compute the volume of a mesh. There are no masses, as the sensor file does not state them.

    Args:
        sensor: any sensor.
        folder: folder of the files; it is created if it does not exist, and files of these names are replaced.

    Returns:
        The path of the folder.

    Limitations:
        The membrane is rigid and at rest. Only the first of several cameras is written.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> from torchmembrane import preset
        >>> with TemporaryDirectory() as folder:
        ...     sorted(path.name for path in write_robot_model(preset("fingertip"), folder).iterdir())
        ['fingertip.urdf', 'fingertip.xml', 'membrane.stl', 'rim.stl']
    """
    folder, name = make_folder(folder), file_stem(sensor)
    pose = sensor.tool or Pose(np.eye(3), np.zeros(3))
    rotation, place = pose.rotation, pose.translation / METRE[sensor.length_unit]
    meshes = {"membrane": closed_membrane(sensor), "rim": rim_tube(sensor)}
    for mesh, (vertices, triangles) in meshes.items():
        write_bytes(folder / f"{mesh}.stl", stl(vertices / METRE[sensor.length_unit] @ rotation.T + place, triangles))
    write_text(folder / f"{name}.urdf", _urdf(sensor.name, list(meshes), rotation, place))
    write_text(folder / f"{name}.xml", _mjcf(sensor, list(meshes), rotation @ OPTICAL_TO_GRAPHICS, place))
    return folder


def file_stem(sensor: Sensor) -> str:
    """Return the sensor's name with `_` for characters that a file name may not contain.

    Example:
        >>> from dataclasses import replace
        >>> from torchmembrane import preset
        >>> file_stem(replace(preset("fingertip"), name="left/finger 2"))
        'left_finger_2'
    """
    return re.sub(r"[^\w.-]", "_", sensor.name).lstrip(".") or "sensor"


def closed_membrane(sensor: Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Return the rest surface with a lid across its rim: vertices `[V + 1, 3]`, camera frame, and outward triangles
    `[T, 3]`."""
    membrane = sensor.membrane
    rest, triangles = membrane.rest.double().numpy(), membrane.triangles.numpy()
    loop = rim_loop((int(membrane.grid[0]), int(membrane.grid[1])))
    lid = np.stack([np.roll(loop, -1), loop, np.full(len(loop), len(rest))], 1)
    edges = {tuple(edge) for triangle in triangles.tolist() for edge in zip(triangle, np.roll(triangle, -1), strict=True)}
    if (int(lid[0, 0]), int(lid[0, 1])) in edges:  # the two sides of an edge run along it in opposite directions
        lid = lid[:, [1, 0, 2]]
    return np.vstack([rest, rest[loop].mean(0)]), np.vstack([triangles, lid])


def rim_tube(sensor: Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Return a closed tube along the rim: vertices and triangles, as in `closed_membrane`."""
    rest, grid = sensor.membrane.rest.double().numpy(), sensor.membrane.grid
    line = rest[rim_loop((int(grid[0]), int(grid[1])))]
    radius = RIM_WIDTH * np.ptp(rest, 0).max()
    along = np.roll(line, -1, 0) - np.roll(line, 1, 0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    outward = line - line.mean(0)
    outward -= (outward * along).sum(1, keepdims=True) * along
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    across, angles = np.cross(along, outward), 2 * np.pi * np.arange(SIDES) / SIDES
    circle = np.cos(angles)[:, None] * outward[:, None] + np.sin(angles)[:, None] * across[:, None]
    n, k = len(line), np.arange(len(line) * SIDES).reshape(len(line), SIDES)
    right, up = np.roll(k, -1, 0), np.roll(k, -1, 1)
    diagonal = np.roll(right, -1, 1)
    triangles = np.vstack([np.stack([k, right, diagonal], -1).reshape(-1, 3), np.stack([k, diagonal, up], -1).reshape(-1, 3)])
    vertices = (line[:, None] + radius * circle).reshape(n * SIDES, 3)
    return vertices, triangles[:, ::-1]


def stl(vertices: np.ndarray, triangles: np.ndarray) -> bytes:
    """Return the content of a binary STL file."""
    corners = vertices[triangles].astype("<f4")
    record = np.zeros(len(triangles), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    record["normal"] = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo("f4").tiny)
    record["corners"] = corners
    return b"torchmembrane".ljust(80) + np.array(len(triangles), "<u4").tobytes() + record.tobytes()


def roll_pitch_yaw(rotation: np.ndarray) -> np.ndarray:
    """Return the angles about the fixed axes x, y, z, rad, as in URDF: `rotation = Rz(yaw) Ry(pitch) Rx(roll)`."""
    pitch = np.arctan2(-rotation[2, 0], np.hypot(rotation[0, 0], rotation[1, 0]))
    if np.hypot(rotation[0, 0], rotation[1, 0]) < 1e-9:  # yaw and roll are about one axis: all is given to roll
        return np.array([np.arctan2(-rotation[1, 2], rotation[1, 1]), pitch, 0.0])
    return np.array([np.arctan2(rotation[2, 1], rotation[2, 2]), pitch, np.arctan2(rotation[1, 0], rotation[0, 0])])


def _urdf(name: str, meshes: list[str], rotation: np.ndarray, place: np.ndarray) -> str:
    robot = ElementTree.Element("robot", name=name)
    link = ElementTree.SubElement(robot, "link", name=name)
    for kind in ("visual", "collision"):
        for mesh in meshes:
            part = ElementTree.SubElement(link, kind, name=f"{mesh}_{kind}")
            ElementTree.SubElement(ElementTree.SubElement(part, "geometry"), "mesh", filename=f"{mesh}.stl")
    ElementTree.SubElement(robot, "link", name=f"{name}_camera")
    joint = ElementTree.SubElement(robot, "joint", name=f"{name}_camera_joint", type="fixed")
    ElementTree.SubElement(joint, "parent", link=name)
    ElementTree.SubElement(joint, "child", link=f"{name}_camera")
    ElementTree.SubElement(joint, "origin", xyz=_numbers(place), rpy=_numbers(roll_pitch_yaw(rotation)))
    return _text(robot)


def _mjcf(sensor: Sensor, meshes: list[str], rotation: np.ndarray, place: np.ndarray) -> str:
    model = ElementTree.Element("mujoco", model=sensor.name)
    asset = ElementTree.SubElement(model, "asset")
    body = ElementTree.SubElement(ElementTree.SubElement(model, "worldbody"), "body", name=sensor.name)
    for mesh in meshes:
        ElementTree.SubElement(asset, "mesh", name=mesh, file=f"{mesh}.stl")
        ElementTree.SubElement(body, "geom", name=mesh, type="mesh", mesh=mesh)
    width, height = sensor.camera.image_size
    view = np.degrees(2 * np.arctan(height / 2 / float(sensor.camera.focal[1])))
    axes = _numbers(np.concatenate([rotation[:, 0], rotation[:, 1]]))
    camera = {"name": f"{sensor.name}_camera", "pos": _numbers(place), "xyaxes": axes, "fovy": f"{view:.6g}"}
    ElementTree.SubElement(body, "camera", camera | {"resolution": f"{width} {height}"})
    return _text(model)


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{value + 0.0:.9g}" for value in np.round(values, 12))


def _text(element: ElementTree.Element) -> str:
    ElementTree.indent(element)
    return ElementTree.tostring(element, encoding="unicode", xml_declaration=True) + "\n"
