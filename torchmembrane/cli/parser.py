"""The parser of every command: wrong arguments get a two-line answer with a suggestion of what was probably meant."""

import re
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from typing import NoReturn


class CommandParser(ArgumentParser):
    """An `ArgumentParser` that accepts `--direction -0.5,0,0.87` as a value, and reports unknown options of its own command.

    Example:
        >>> parser = CommandParser(prog="p")
        >>> _ = parser.add_argument("--direction")
        >>> parser.parse_args(["--direction", "-0.5,0,1"]).direction
        '-0.5,0,1'
    """

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: Namespace | None = None
    ) -> tuple[Namespace, list[str]]:
        """Parse as `ArgumentParser` does, but refuse unknown arguments here, where the options of the command are known."""
        parsed, unknown = super().parse_known_args(negative_joined(sys.argv[1:] if args is None else args), namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return parsed, []

    def error(self, message: str) -> NoReturn:
        """Print what is wrong, where the arguments are listed, and what was probably meant; exit with status 2."""
        self.exit(2, f"usage: {self.prog} --help lists all arguments\n{self.prog}: error: {message}{self._meant(message)}\n")

    def _meant(self, message: str) -> str:
        from ..sensor.suggestions import did_you_mean  # here: torch comes with the package

        if wrong := re.match(r"argument (.*): invalid choice: '?(.*?)'? \(choose from (.*)\)", message):
            return _appended(did_you_mean(wrong[2], re.findall(r"[\w-]+", wrong[3])))
        if wrong := re.match(r"unrecognized arguments: --([\w-]+)", message):
            options = {name.replace("-", "_"): name for name in re.findall(r"--([\w-]+)", self.format_usage())}
            meant = did_you_mean(wrong[1], options)
            return _appended(re.sub(r"'(\w+)'", lambda name: f"--{options[name[1]]}", meant))
        return ""


def _appended(question: str) -> str:
    return f"; {question}" if question else ""


def negative_joined(arguments: Sequence[str]) -> list[str]:
    """Return the arguments; each one that begins with a minus sign and a digit is joined to the option before it, as its
    value.

    Example:
        >>> negative_joined(["--direction", "-0.5,0,1", "-v", "a.png"])
        ['--direction=-0.5,0,1', '-v', 'a.png']
    """
    joined: list[str] = []
    for argument in arguments:
        if re.match(r"-\.?\d", argument) and joined and re.fullmatch(r"--[\w-]+", joined[-1]):
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined
