"""The command line: python -m tiverlet run | play | replay | report | report speed | stress | demos | info."""

import argparse
import sys

from . import __version__
from .commands import demos, info, play, replay, report, run, speed, stress

# Each module has ABOUT (one line), add(parser) for its arguments, and main(args) -> exit status. A name may have two words.
COMMANDS = {
    "run": run,
    "play": play,
    "replay": replay,
    "report": report,
    "report speed": speed,
    "stress": stress,
    "demos": demos,
    "info": info,
}


def main(words: list[str] | None = None) -> int:
    """Run one command; return the exit status."""
    parser = argparse.ArgumentParser(prog="tiverlet", description="A particle engine on Taichi.")
    parser.add_argument("--version", action="version", version=f"tiverlet {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="command")
    for name, command in COMMANDS.items():
        command.add(commands.add_parser(name, help=command.ABOUT, description=command.__doc__))
    words = sys.argv[1:] if words is None else words
    two = " ".join(words[:2])
    args = parser.parse_args([two, *words[2:]] if two in COMMANDS else words)
    try:
        return COMMANDS[args.command].main(args)
    except (ValueError, TypeError, RuntimeError, OSError, ImportError) as error:
        print(f"tiverlet {args.command}: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
