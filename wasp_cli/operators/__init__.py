"""Simulated human operators."""
