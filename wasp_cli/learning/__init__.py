"""Loops that turn interaction and data into weights."""
