"""Commands of `python -m tiverlet`, one per file: ABOUT, add(parser) and main(args) -> exit status.

Commands import packages when they run, so that --help is quick.
"""
