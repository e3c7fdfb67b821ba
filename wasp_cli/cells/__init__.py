"""What a results folder holds: its runs, its cells, and their episodes as one table."""
