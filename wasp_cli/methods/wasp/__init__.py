"""WASP: gates, returns and residual planning (sections 4.2 and 4.3 of the paper)."""
