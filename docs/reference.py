"""The page docs/command.md, from the command's own parsers.

python docs/reference.py [--out docs/command.md]
"""

import argparse
from pathlib import Path

from torchmembrane.cli.main import command_parser

HEAD = """\
# The command

This page lists every option of every command. `torchmembrane COMMAND --help` prints the same. The page is made
by `python docs/reference.py`.
`SENSOR.toml` may be `preset:NAME` ([which](presets.md)). Exit codes: 0 all well, 1 some frames failed, 2 wrong usage, 130
ended by Ctrl-C, 143 by SIGTERM.

Ctrl-C and SIGTERM end a command within some two seconds, or with the frame in work; what is done so far is kept. A second one
ends it at once: files are whole all the same, and the same command goes on from there where it can.

No command writes over a file that it reads. Another file that is there already is written over with `--force` only, but for
the results of a folder in which `reconstruct` goes on, the frames of a folder that `simulate` made, and figures that the same
command drew (their files say so). A symbolic link in a file's place is replaced; what it points to is left alone. Files are
written whole or not at all.
"""


def page() -> str:
    """The whole page."""
    sections = [HEAD]
    for name, parser in subcommands(command_parser()).items():
        steps = subcommands(parser)
        sections.append(section(f"## {name}", parser, "" if steps else f"torchmembrane {name}"))
        sections += [section(f"### {name} {step}", it, f"torchmembrane {name} {step}") for step, it in steps.items()]
    return "\n".join(sections)


def subcommands(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """Parsers of its commands by name, without their other names."""
    found = {}
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, child in action.choices.items():
                if child not in found.values():
                    found[name] = child
    return found


def section(title: str, parser: argparse.ArgumentParser, called: str) -> str:
    """Purpose, options as a table, examples."""
    lines = [title, "", parser.description or "", ""]
    actions = [a for a in parser._actions if not isinstance(a, argparse._HelpAction | argparse._SubParsersAction)]
    if called and actions:
        lines += ["| option | what |", "|---|---|", *map(row, actions), ""]
    if parser.epilog:
        lines += ["```text", parser.epilog, "```", ""]
    return "\n".join(lines)


def row(action: argparse.Action) -> str:
    """A line of the table: how it is written, what it says, which values it takes."""
    named = action.metavar or action.dest.upper()
    value = "" if action.nargs == 0 else named if isinstance(named, str) else " ".join(named)
    names = ", ".join(f"{name} {value}".strip() for name in action.option_strings) or value
    help = (action.help or "") % {"default": action.default, "dest": action.dest}
    words = [help] + ([f"one of {', '.join(map(str, action.choices))}"] if action.choices else [])
    words += ["required"] if action.required and action.option_strings else []
    return f"| `{escaped(names)}` | {escaped('; '.join(words))} |"


def escaped(text: str) -> str:
    return text.replace("|", "\\|")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "command.md")
    parser.parse_args().out.write_text(page())


if __name__ == "__main__":
    main()
