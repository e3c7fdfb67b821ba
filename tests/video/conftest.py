"""Tiny untrained models, and a cell that an assistant was evaluated in with them."""

from tests.learning.conftest import cell, inputs

__all__ = ["cell", "inputs"]
