"""Stability in stiff and extreme cases: the certificate, perturbed scenes, and the trace of a failure."""
