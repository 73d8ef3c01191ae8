"""A frame's result as ROS 2 messages in N, N m, m and Pa, with the same topics, types and fields in bags and live.

Vectors are in the camera's optical frame: x right, y down, z forward.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ..errors import MembraneError
from ..results.reconstruction import Frame
from ..results.status import Status
from ..results.store import Mesh
from ..results.view_status import status_in_words
from ..sensor.units import METRE

TOPICS = {
    "wrench": "geometry_msgs/msg/WrenchStamped",
    "force_deviation": "geometry_msgs/msg/Vector3Stamped",
    "points": "sensor_msgs/msg/PointCloud2",
    "contacts": "sensor_msgs/msg/PointCloud2",
    "pressure": "sensor_msgs/msg/FluidPressure",
    "status": "diagnostic_msgs/msg/DiagnosticArray",
}
"""Message types by the last name of their topic; each message has a header."""
POINT_FIELDS = ("x", "y", "z", "normal_traction", "shear_x", "shear_y", "shear_z")
"""Fields of a vertex, each float32: position, m; compressive normal traction and shear traction on the membrane, Pa."""
CONTACT_FIELDS = ("x", "y", "z", "force_x", "force_y", "force_z", "normal_x", "normal_y", "normal_z", "area")
"""Fields of a contact, strongest first, each float32: position, m; force on the membrane, N; outward normal; area, m^2."""
FLOAT32 = 7
"""PointField's code for float32."""
GOOD, DOUBTFUL, FAILED = range(3)
"""Levels of a DiagnosticStatus: OK, WARN and ERROR."""


class Message(NamedTuple):
    """A message or a part of one: its type, and its fields, which may be messages or lists of messages."""

    kind: str
    fields: dict[str, Any]

    def built(self, make: Callable[..., Any]) -> Any:
        """Build the message with a library's message classes.

        Args:
            make: function called with the type and with the fields by name.

        Example:
            >>> vector = Message("geometry_msgs/msg/Vector3", {"x": 1.0, "y": 0.0, "z": 0.0})
            >>> Message("geometry_msgs/msg/Wrench", {"force": vector}).built(lambda kind, **fields: (kind[-6:], fields))
            ('Wrench', {'force': ('ector3', {'x': 1.0, 'y': 0.0, 'z': 0.0})})
        """
        return make(self.kind, **{name: _built(value, make) for name, value in self.fields.items()})


def _built(value: Any, make: Callable[..., Any]) -> Any:
    if isinstance(value, list):
        return [_built(each, make) for each in value]
    return value.built(make) if isinstance(value, Message) else value


class SiUnits:
    """Conversion of a sensor's results to N, N m, m and Pa.

    Args:
        mesh: mesh of the results.
        gas_pressure: `Sensor.gas_pressure`.

    Raises:
        MembraneError: the forces of the sensor are relative.
    """

    def __init__(self, mesh: Mesh, gas_pressure: float | None = None):
        if mesh.force_unit != "N":
            raise MembraneError(
                f"forces of {mesh.name} are relative, but messages are in newtons: add shear_modulus and thickness to the "
                "sensor file, or find the stiffness by `torchmembrane calibrate material --weight`"
            )
        self.name, self.metre, self.views = mesh.name, METRE[mesh.length_unit], mesh.view_names.split()
        self.gas_pressure = gas_pressure

    def topics(self) -> list[str]:
        """Return the names in `TOPICS` that this sensor publishes: `pressure` requires a gas."""
        return [name for name in TOPICS if name != "pressure" or self.gas_pressure is not None]

    def messages(self, frame: Frame) -> dict[str, Message]:
        """Return a frame's messages by topic, without headers; for a frame without a surface, only its status.

        Args:
            frame: arrays of the frame, as returned by `Reconstruction.frame`.
        """
        found = {"status": _stamped("status", status=[self._status(frame)])}
        if has_wrench(frame):
            vectors = {"force": _vector(frame["wrench"][:3]), "torque": _vector(self.moment(frame))}
            wrench = Message("geometry_msgs/msg/Wrench", vectors)
            found["wrench"] = _stamped("wrench", wrench=wrench)
            found["force_deviation"] = _stamped("force_deviation", vector=_vector(frame["force_deviation"]))
            found["points"] = _stamped("points", **cloud(self.points(frame), POINT_FIELDS))
            found["contacts"] = _stamped("contacts", **cloud(self.contacts(frame), CONTACT_FIELDS))
            if self.gas_pressure is not None:
                found["pressure"] = _stamped("pressure", fluid_pressure=self.pressure(frame), variance=0.0)
        return found

    def moment(self, frame: Frame) -> np.ndarray:
        """Return the moment about the camera's centre of projection, `[3]` N m, from the last three components of the
        `wrench [6]`."""
        return frame["wrench"][3:].astype(float) / self.metre

    def points(self, frame: Frame) -> np.ndarray:
        """Return `POINT_FIELDS` of every vertex, `[V, 7]` float32, from its `vertices`, `normals` and `traction`, `[V, 3]`
        each."""
        traction, normals = frame["traction"] * self.metre**2, frame["normals"]
        along = (traction * normals).sum(-1, keepdims=True)
        return np.hstack([frame["vertices"] / self.metre, -along, traction - along * normals]).astype(np.float32)

    def contacts(self, frame: Frame) -> np.ndarray:
        """Return `CONTACT_FIELDS` of every contact, `[n, 10]` float32."""
        area = frame["contact_area"][:, None] / self.metre**2
        each = np.hstack([frame["contact_points"] / self.metre, frame["contact_force"], frame["contact_normal"], area])
        return each[np.isfinite(frame["contact_points"]).all(-1)].astype(np.float32)

    def pressure(self, frame: Frame) -> float | None:
        """Return the absolute gas pressure, Pa, from the frame's `pressure_change []`; None for a sensor without gas."""
        if self.gas_pressure is None:
            return None
        return (self.gas_pressure + float(frame["pressure_change"])) * self.metre**2

    def _status(self, frame: Frame) -> Message:
        """Return a frame's status in words, with the values on which it is based."""
        status = Status(int(frame["status"]))
        values = {
            "status": str(int(status)),
            "residual, px": ", ".join(f"{residual:.3f}" for residual in np.atleast_1d(frame["residual"])),
            "coverage": f"{frame['coverage']:.3f}",
        }
        level = GOOD if status == Status.OK else DOUBTFUL if status.has_surface else FAILED
        return diagnosis(level, self.name, status_in_words(frame, self.views), values)


def diagnosis(level: int, name: str, text: str, values: dict[str, str]) -> Message:
    """Return a `DiagnosticStatus`; `level` is `GOOD`, `DOUBTFUL` or `FAILED`."""
    pairs = [Message("diagnostic_msgs/msg/KeyValue", {"key": key, "value": value}) for key, value in values.items()]
    fields = {"level": level, "name": name, "message": text, "hardware_id": name, "values": pairs}
    return Message("diagnostic_msgs/msg/DiagnosticStatus", fields)


def cloud(points: np.ndarray, names: tuple[str, ...]) -> dict[str, Any]:
    """Return the fields of a `sensor_msgs/PointCloud2` of `points [n, len(names)]` without its header; `data` are uint8."""
    step = 4 * len(names)
    fields = [{"name": name, "offset": 4 * k, "datatype": FLOAT32, "count": 1} for k, name in enumerate(names)]
    shape = {"height": 1, "width": len(points), "is_bigendian": False, "point_step": step, "row_step": step * len(points)}
    content = np.frombuffer(points.astype("<f4").tobytes(), np.uint8)
    layout = {"fields": [Message("sensor_msgs/msg/PointField", each) for each in fields], "data": content}
    return {**shape, **layout, "is_dense": bool(np.isfinite(points).all())}


def has_wrench(frame: Frame) -> bool:
    """Return whether a frame has a surface, and therefore a wrench."""
    return Status(int(frame["status"])).has_surface


def _stamped(topic: str, **fields: Any) -> Message:
    return Message(TOPICS[topic], fields)


def _vector(values: np.ndarray) -> Message:
    return Message("geometry_msgs/msg/Vector3", dict(zip("xyz", values.astype(float).tolist(), strict=True)))
