"""Two results folders, cell by cell: what differs, why, and whether it is more than chance."""
