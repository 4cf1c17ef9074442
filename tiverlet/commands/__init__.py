"""The commands of `python -m tiverlet`: one module each, with ABOUT, add(parser) and main(args) -> exit status."""
