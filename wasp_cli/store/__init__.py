"""Bytes on disk: every path is made here."""
