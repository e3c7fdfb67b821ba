"""What serves a page to a browser of this machine alone: `wasp drive` and `wasp view` stand on it."""
