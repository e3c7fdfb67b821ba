"""Assistants: everything that the main table compares."""
