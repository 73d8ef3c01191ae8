"""The page docs/command.md, from the command's own parsers.

python docs/reference.py [--out docs/command.md]
"""

import argparse
from pathlib import Path

from torchmembrane.cli.main import command_parser

HEAD = """\
# The command

This page lists every option of every command. `torchmembrane COMMAND --help` prints the same. `python docs/reference.py`
generates this page.

Except in `init`, which writes it, `SENSOR.toml` may be `preset:NAME`, one of the [presets](presets.md). "The paper" is the one
that [the paper, part by part](paper.md) explains; other terms are in the [glossary](glossary.md).

The exit code is 0 if all went well, 1 if some frames or presses failed, 2 for wrong usage and for every other error that is
reported, 130 after Ctrl-C, and 143 after SIGTERM; `live` ends with 0 after either.

Ctrl-C or SIGTERM ends a command within some two seconds, or when the current frame is finished. Finished results are kept. A
second Ctrl-C or SIGTERM ends the command at once; even then, no file is left half written. The same command, started again,
continues where it was interrupted, if it can.

No command overwrites the images, recordings and tables that it is given. Other existing files are overwritten only with
`--force`. What continues or replaces earlier work of the same command needs no `--force`: the results in a folder that
`reconstruct` continues, and its bag; the frames in a folder that `simulate` made; figures that the same command drew (a mark in
the file identifies them); the file of `live --life`; the folder of `check --robot`; and the tested range that
`check --accuracy` keeps beside the sensor file. If a symbolic link has the name of a file to be written, the link is replaced
and its target is left alone. Files are written completely or not at all.
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
    value = {"+": f"{value} ...", "*": f"[{value} ...]", "?": f"[{value}]"}.get(str(action.nargs), value)
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
