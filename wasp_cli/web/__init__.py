"""A local server with a token, for `wasp view` and `wasp drive`."""
