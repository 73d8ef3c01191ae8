"""The node as an ament package; its Python dependency, torchmembrane, is installed separately with pip."""

from glob import glob

from setuptools import setup

setup(
    name="torchmembrane_ros",
    version="0.2.0",
    packages=["torchmembrane_ros"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/torchmembrane_ros"]),
        ("share/torchmembrane_ros", ["package.xml"]),
        ("share/torchmembrane_ros/config", glob("config/*.yaml")),
        ("share/torchmembrane_ros/launch", glob("launch/*.launch.py")),
    ],
    license="MIT",
    entry_points={"console_scripts": ["tracker = torchmembrane_ros.node:main"]},
)
