"""The command line: python -m tiverlet run | play | replay | report | stress | demos | info."""

import argparse
import sys

from . import __version__
from .commands import demos, info, play, replay, report, run, stress

# Each module has ABOUT (one line), add(parser) for its arguments, and main(args) -> exit status.
COMMANDS = {"run": run, "play": play, "replay": replay, "report": report, "stress": stress, "demos": demos, "info": info}


def main(words: list[str] | None = None) -> int:
    """Run one command; return the exit status."""
    parser = argparse.ArgumentParser(prog="tiverlet", description="A particle engine on Taichi.")
    parser.add_argument("--version", action="version", version=f"tiverlet {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="command")
    for name, command in COMMANDS.items():
        command.add(commands.add_parser(name, help=command.ABOUT, description=command.__doc__))
    args = parser.parse_args(words)
    try:
        return COMMANDS[args.command].main(args)
    except (ValueError, TypeError, RuntimeError, OSError, ImportError) as error:
        print(f"tiverlet {args.command}: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
