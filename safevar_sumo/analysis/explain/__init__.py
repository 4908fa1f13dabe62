"""Explain failures: which changes cause them, how little of them is enough, why, and whether they are robust."""
