"""The project's laboratory: tiverlet beside other engines and known laws. Run by hand: `python -m tests.laboratory NAME`."""
