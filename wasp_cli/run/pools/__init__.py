"""The workers of a run: what a pool is (`base`), a file for each kind, and the `choice` of one."""
