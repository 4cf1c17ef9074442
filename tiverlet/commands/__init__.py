"""Commands of `python -m tiverlet`, one in each file: ABOUT, add(parser) and main(args) -> exit status.

They import what they need when they run, so that --help is quick.
"""
