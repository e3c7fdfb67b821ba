"""wasp: an experiment orchestrator for safety-aware shared autonomy with world-model constrained planning."""

__version__ = "0.1.0"
