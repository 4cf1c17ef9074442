"""The contract of features: forces, constraints, contacts and walls."""
