"""The step `layout`: from the dots wanted in the image to positions on the rest surface."""

from argparse import Namespace
from dataclasses import replace

from ...calibrate.layout import layout_for_pixels, pixel_lattice, read_pixels, write_layout, write_svg
from ...errors import MembraneError
from ...plot.calibration import layout_figure
from ...plot.files import save
from ...presets import sensor_file
from ...sensor.parts import Markers
from ...sensor.sensor import Sensor
from ...sensor.toml import read_sensor


def layout(arguments: Namespace) -> int:
    """`torchmembrane calibrate layout`"""
    sensor = Sensor(*read_sensor(sensor_file(arguments.sensor), undotted=True))
    if (arguments.pixels is None) == (arguments.pitch is None):
        raise MembraneError("calibrate layout: expected either --pixels FILE or --pitch PX")
    wanted = read_pixels(arguments.pixels) if arguments.pixels else pixel_lattice(sensor, arguments.pitch)
    dots = layout_for_pixels(sensor, *wanted)
    made = replace(sensor, markers=Markers("dots", sensor.markers.polarity, dots.positions, dots.sizes))
    path = made.to_file(arguments.out)
    write_layout(arguments.out / "layout.csv", sensor, dots)
    write_svg(arguments.out / "layout.svg", sensor, dots)
    title = f"{len(dots.radii)} dots, radii {dots.radii.min():.3g} to {dots.radii.max():.3g} {sensor.length_unit}"
    save(layout_figure(title, sensor, dots), arguments.out / "report.png", "calibrate")
    print(f"{title}\n{arguments.out / 'layout.csv'} for fabrication, layout.svg for viewing, sensor with these dots: {path}")
    return 0
