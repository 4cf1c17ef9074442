"""What tiverlet reports about itself: scenes with known answers, their errors and what they cost."""
