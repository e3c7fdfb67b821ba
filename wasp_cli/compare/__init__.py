"""Two results folders, cell by cell."""
