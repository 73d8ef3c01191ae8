"""Sensors whose membrane stands elsewhere before the camera."""

from dataclasses import replace

from torchmembrane.sensor.parts import Markers, Surface


def moved(sensor, turn, shift, lines=81):
    """The sensor with its membrane and dots turned, then shifted; the surface is stored on so many lines each way."""
    fine = sensor.surface.membrane((lines, lines))
    vertices = (turn.apply(fine.rest.numpy()) + shift).reshape(lines, lines, 3)
    surface = Surface("grid", {"vertices": vertices, "fixed": fine.fixed.numpy().reshape(lines, lines)})
    markers = Markers("dots", "dark", turn.apply(sensor.markers.positions) + shift, sensor.markers.sizes)
    return replace(sensor, membrane=surface.membrane((17, 17)), surface=surface, markers=markers)
