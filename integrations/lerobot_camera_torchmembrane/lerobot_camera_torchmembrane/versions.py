"""The LeRobot release that the plugin was tested with; with any other release the plugin neither uses nor changes anything."""

from importlib.metadata import version

TESTED = "0.6"
"""Tested release of LeRobot; its patch releases (0.6.2 ...) are assumed to be compatible."""


def refuse_untested(installed: str | None = None) -> None:
    """Refuse a LeRobot release that the plugin was not tested with.

    Args:
        installed: version of LeRobot; None: the installed one.

    Raises:
        ImportError: it is another release. LeRobot logs this error and continues without the plugin.
    """
    found = installed or version("lerobot")
    if ".".join(found.split(".")[:2]) != TESTED:
        raise ImportError(
            f"lerobot_camera_torchmembrane was tested with lerobot {TESTED}, and {found} is installed. The plugin does not "
            "change LeRobot: use the release of the plugin for your version, or install "
            f'"lerobot>={TESTED},<0.7" in an environment of its own'
        )
