"""The workers of a run: what a pool is (`base`), one file for each kind, and which is meant."""
