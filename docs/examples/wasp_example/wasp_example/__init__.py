"""An assistant that is trained, and an operator, for `wasp`."""
