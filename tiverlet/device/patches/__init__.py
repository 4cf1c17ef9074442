"""What replaces parts of Taichi 1.7.4, so that kernels compile and launch sooner, to the same bits."""
