"""Which LeRobot the plugin was tested with: of another one nothing is used, and nothing is changed."""

from importlib.metadata import version

TESTED = "0.6"
"""LeRobot's release; its later corrections (0.6.2 ...) are taken to be the same."""


def refuse_untested(installed: str | None = None) -> None:
    """Refuse a LeRobot that the plugin was not tested with.

    Args:
        installed: its version; None: the one that is installed.

    Raises:
        ImportError: it is another release. LeRobot logs that, and goes on without the plugin.
    """
    found = installed or version("lerobot")
    if ".".join(found.split(".")[:2]) != TESTED:
        raise ImportError(
            f"lerobot_camera_torchmembrane was tested with lerobot {TESTED}, and {found} is installed. It changes no LeRobot: "
            f'use the release of the plugin for yours, or install "lerobot>={TESTED},<0.7" in an environment of its own'
        )
