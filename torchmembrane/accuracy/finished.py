"""A file that stores finished series of trials until all are finished, so that an interrupted spec sheet can be resumed."""

import hashlib
import json
from pathlib import Path
from typing import NamedTuple

from ..errors import MembraneError
from ..files.atomic import make_folder, write_text
from ..files.safe_read import read_text
from ..sensor.sensor import Sensor
from ..user_warnings import warn_user
from .spec_sheet import Effort, Outcome, PairTrial, PressTrial, RestTrial

MOST_BYTES = 2**26
EXPECTED = "series of trials as check --accuracy keeps them"


class FinishedSeries(NamedTuple):
    """The file that stores finished series, and their outcomes.

    Attributes:
        path: path of the file, which need not exist.
        outcomes: outcomes of the finished series, by number.
    """

    path: Path
    outcomes: dict[int, Outcome]

    @classmethod
    def resumed(
        cls, folder: Path, version: str, sensor: Sensor, seed: int, noise: float | None, effort: Effort
    ) -> "FinishedSeries":
        """Open the file of one spec sheet; its name depends on version, sensor, seed, noise and effort.

        Args:
            folder: folder of the file.
            version: version of the package.
            sensor: the sensor.
            seed: seed of the trials.
            noise: noise of the images, dB; None: that of the rest image.
            effort: number of trials.

        Raises:
            MembraneError: the file cannot be read.
        """
        key = json.dumps([version, sensor.fingerprint, seed, noise, effort])
        path = folder / f"accuracy-{hashlib.sha256(key.encode()).hexdigest()[:12]}.unfinished.json"
        return cls(path, _read(path) if path.exists() else {})

    def keep(self, number: int, outcome: Outcome) -> None:
        """Add the outcome of one series and rewrite the file atomically.

        Args:
            number: number of the series.
            outcome: outcome of the series.
        """
        self.outcomes[number] = outcome
        try:
            make_folder(self.path.parent)
            write_text(self.path, json.dumps(self.outcomes))
        except MembraneError as error:
            warn_user(f"{error}; an interruption loses what is done")

    def remove(self) -> None:
        """Remove the file after the spec sheet is complete."""
        self.path.unlink(missing_ok=True)


def _read(path: Path) -> dict[int, Outcome]:
    try:
        content = json.loads(read_text(path, MOST_BYTES, EXPECTED))
        return {int(number): _outcome(*fields) for number, fields in content.items()}
    except MembraneError:
        raise
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise MembraneError(f"{path}: not readable; expected {EXPECTED}: remove the file to begin anew") from error


def _outcome(rest: list[list], presses: list[list], pairs: list[list], reason: str) -> Outcome:
    return Outcome(
        [RestTrial(*trial) for trial in rest],
        [PressTrial(*trial) for trial in presses],
        [PairTrial(*trial) for trial in pairs],
        reason,
    )
